"""Errors a user can cause. Each carries one sentence: what is wrong, where, and what to do."""


class SNHError(Exception):
    """Base of all errors that the command line prints as one sentence."""


class ConfigError(SNHError):
    """A setting that does not exist or is out of range."""


class DataError(SNHError):
    """Input that cannot be used: a missing folder, a broken image, colour without depth."""


class OutputError(SNHError):
    """Results that cannot be written: no permission, no space."""
