"""The order of the rooms: a room imports only rooms below it in the picture of docs/design.md; no circles."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "taichi_edges"


def rooms_of_the_picture():
    """Names of the rooms, topmost first."""
    picture = (ROOT / "docs" / "design.md").read_text(encoding="utf-8").partition("## Rooms")[2].partition("\n## ")[0]
    return re.findall(r"^ {8}(\w+)(?:/|\.py) ", picture, re.MULTILINE)


def modules_in(tree):
    """All of ours that a syntax tree imports, at its top or later; `a.b.c` for a name c of the module a.b as well."""
    for node in ast.walk(tree):
        names = [name.name for name in node.names] if isinstance(node, (ast.Import, ast.ImportFrom)) else []
        start = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
        yield from (f"{start}{name}" for name in names if f"{start}{name}".startswith("taichi_edges."))


def imports():
    """(room, module) of all that a file of a room imports from other rooms, at its top or later."""
    for path in sorted(PACKAGE.rglob("*.py")):
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        modules = modules_in(ast.parse(path.read_text(encoding="utf-8")))
        yield from ((room, module) for module in modules if module.split(".")[1] != room)


class WithoutTypes(ast.NodeTransformer):
    """Takes out what is imported for a type checker alone."""

    def visit_If(self, node):
        return None if ast.unparse(node.test) == "TYPE_CHECKING" else self.generic_visit(node)


def imported_when_run():
    """{module: set of those that it imports when it is run}, at its top or later."""
    paths = sorted(PACKAGE.rglob("*.py"))
    names = {path: ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths}
    found = {}
    for path, name in names.items():
        modules = modules_in(WithoutTypes().visit(ast.parse(path.read_text(encoding="utf-8"))))
        wanted = {part for module in modules for part in (module, module.rpartition(".")[0])}
        found[name] = wanted & set(names.values()) - {name, "taichi_edges"}
    return found


def test_the_picture_has_every_room_once():
    here = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert sorted(rooms_of_the_picture()) == sorted(here - {"__init__", "__main__", "__pycache__"})


def test_rooms_import_only_rooms_below_them():
    order = rooms_of_the_picture()
    found = [(room, module) for room, module in imports() if room in order]
    upwards = [pair for pair in found if order.index(pair[1].split(".")[1]) < order.index(pair[0])]
    assert len(found) > 300 and upwards == []


def test_modules_import_each_other_in_no_circle():
    order = list(TopologicalSorter(imported_when_run()).static_order())  # CycleError names the circle
    assert len(order) > 100
