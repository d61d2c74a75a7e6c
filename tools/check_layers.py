"""Checks that every import inside snh points downward, and that third-party packages stay where they belong.

    python tools/check_layers.py

Prints one line per offence and exits with 1 if there is any. Imports inside functions count like all others.
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "snh"

# Lowest first. A part may import parts of lower layers only; those of one layer do not know each other.
LAYERS = [
    {"errors"},
    {"config", "geometry", "frame", "files"},
    {"_core"},  # the native library without torch
    {"ops"},
    {"nn", "datasets", "mesh"},
    {"slam", "eval", "viz"},
    {"run", "compare", "doctor"},  # one part per command of the command line
    {"cli"},
    {"", "__main__"},  # snh/__init__.py hands out the public names
]
LEVEL = {part: level for level, parts in enumerate(LAYERS) for part in parts}
SIDEWAYS: set[tuple[str, str]] = set()  # (importer, imported) within one layer

# Where heavy packages may be imported; those not named here may be imported anywhere.
CONFINED = {
    "cv2": {"datasets", "viz"},
    "open3d": {"mesh", "eval", "viz"},
    "trimesh": {"mesh", "eval", "viz"},
    "matplotlib": {"viz"},
    "torch": {"ops", "nn", "slam", "mesh", "eval", "viz", "run", "doctor"},
}


def part_of(path: Path) -> str:
    """The part of snh that a file belongs to: its package, or its own name at the top."""
    inside = path.relative_to(PACKAGE)
    name = inside.parts[0] if len(inside.parts) > 1 else inside.stem
    return "" if name == "__init__" else name


def imports_of(path: Path) -> Iterator[tuple[int, str]]:
    """Line and full dotted name of every module or name that a file imports."""
    package = ["snh", *path.relative_to(PACKAGE).parts[:-1]]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)


def offence(importer: str, name: str) -> str | None:
    """Why a part must not import a name, or None."""
    top, _, rest = name.partition(".")
    if top != "snh":
        allowed = CONFINED.get(top)
        if allowed is None or importer in allowed:
            return None
        return f"{top} is for {', '.join(sorted(allowed))} only"
    imported = rest.partition(".")[0]
    if imported == "__version__" or imported == importer:
        return None
    if imported not in LEVEL:
        return f"snh.{imported} has no place in LAYERS"
    if LEVEL[imported] < LEVEL[importer] or (importer, imported) in SIDEWAYS:
        return None
    return f"{importer or 'snh'} must not import {imported}: it stands on the same layer or above"


def main() -> int:
    offences = []
    for path in sorted(PACKAGE.rglob("*.py")):
        importer, place = part_of(path), path.relative_to(PACKAGE.parent)
        if importer not in LEVEL:
            offences.append(f"{place}: {importer} has no place in LAYERS of tools/check_layers.py")
            continue
        for line, name in imports_of(path):
            why = offence(importer, name)
            if why:
                offences.append(f"{place}:{line}: imports {name}; {why}")
        if importer != "ops" and "torch.ops.snh" in path.read_text(encoding="utf-8"):
            offences.append(f"{place}: calls torch.ops.snh; the native ops are reached through snh.ops")
    print("\n".join(offences), end="\n" if offences else "")
    return 1 if offences else 0


if __name__ == "__main__":
    sys.exit(main())
