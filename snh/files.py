"""Files that are either complete or not there."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from snh.errors import OutputError


def write_atomically(path: str | Path, data: bytes) -> None:
    """Write `data` to a temporary file beside `path` and rename it, so that a reader never sees half a file.

    Raises OutputError when the folder is missing or not writable, or the disk is full; what was at `path` before stays.
    """
    path = Path(path)
    temporary = None
    try:
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)
        reason = error.strerror or str(error)
        raise OutputError(f"Cannot write {path}: {reason}; choose another output folder or free space.") from error


def _umask() -> int:
    """The process's file mode mask; reading it needs setting it. mkstemp ignores it and makes private files."""
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
