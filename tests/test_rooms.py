"""The order of the rooms: a room imports only rooms that stand below it in the picture of docs/design.md."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "taichi_edges"


def rooms_of_the_picture():
    """Names of the rooms, topmost first."""
    picture = (ROOT / "docs" / "design.md").read_text(encoding="utf-8").partition("## Rooms")[2].partition("\n## ")[0]
    return re.findall(r"^ {8}(\w+)(?:/|\.py) ", picture, re.MULTILINE)


def imports():
    """(room, module) of all that a file of a room imports from other rooms, at its top or later."""
    for path in sorted(PACKAGE.rglob("*.py")):
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [name.name for name in node.names] if isinstance(node, (ast.Import, ast.ImportFrom)) else []
            start = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
            modules = (f"{start}{name}" for name in names if f"{start}{name}".startswith("taichi_edges."))
            yield from ((room, module) for module in modules if module.split(".")[1] != room)


def test_the_picture_has_every_room_once():
    here = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert sorted(rooms_of_the_picture()) == sorted(here - {"__init__", "__main__", "__pycache__"})


def test_rooms_import_only_rooms_below_them():
    order = rooms_of_the_picture()
    found = [(room, module) for room, module in imports() if room in order]
    upwards = [pair for pair in found if order.index(pair[1].split(".")[1]) < order.index(pair[0])]
    assert len(found) > 300 and upwards == []
