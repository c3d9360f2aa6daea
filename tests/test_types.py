"""Everything public says its types; mypy (`make lint`) checks that they are true."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "taichi_edges"


def public_functions(tree):
    """(name, node) of the functions and methods that others may call, but for Taichi's, whose compiler reads types."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from ((f"{node.name}.{name}", function) for name, function in public_functions(node))
        elif isinstance(node, ast.FunctionDef) and (not node.name.startswith("_") or node.name == "__init__"):
            decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
            yield from [] if any("ti." in decorator for decorator in decorators) else [(node.name, node)]


def untyped(node):
    """Names of the parameters without a type, and 'return'."""
    arguments = node.args
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    starred = [argument for argument in (arguments.vararg, arguments.kwarg) if argument]
    missing = [a.arg for a in (*named, *starred) if a.annotation is None and a.arg not in ("self", "cls")]
    return missing + (["return"] if node.returns is None and node.name != "__init__" else [])


def test_everything_public_has_types():
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for name, node in public_functions(ast.parse(path.read_text(encoding="utf-8"))):
            found += [f"{path.relative_to(PACKAGE)}:{node.lineno} {name}: {part}" for part in untyped(node)]
    assert found == []
