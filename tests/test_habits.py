"""What the tests hold to: public names, random numbers that can be repeated, a file for what they share."""

import ast
from functools import lru_cache
from pathlib import Path

FILES = sorted(Path(__file__).parent.glob("*.py"))
OF_NUMPY = {"default_rng", "Generator", "SeedSequence"}  # all else in numpy.random is of one hidden state


@lru_cache
def nodes():
    """(file:line, node) of everything in the tests."""
    trees = {path.name: ast.parse(path.read_text(encoding="utf-8")) for path in FILES}
    return [(f"{name}:{getattr(node, 'lineno', 0)}", node) for name, tree in trees.items() for node in ast.walk(tree)]


def is_private(name):
    return name.startswith("_") and not name.startswith("__") and name != "_"


def names_of_others(node):
    """What an expression names in other modules: imported, as an attribute, or patched as text."""
    if isinstance(node, ast.ImportFrom):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.Attribute) and not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
        return [node.attr]
    if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("setattr"):
        words = [word.value for word in node.args if isinstance(word, ast.Constant) and isinstance(word.value, str)]
        return [name for word in words for name in word.split(".")]
    return []


def test_no_test_uses_private_names_of_other_modules():
    assert [(place, name) for place, node in nodes() for name in names_of_others(node) if is_private(name)] == []


def test_no_random_number_is_without_a_seed():
    """The fixture `generator` has one that is printed; default_rng(3) is another way."""
    found = []
    for place, node in nodes():
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("default_rng") and not node.args:
            found.append(place)
        if isinstance(node, ast.Attribute) and node.attr not in OF_NUMPY and ast.unparse(node.value) == "np.random":
            found.append(place)
        if isinstance(node, ast.Import):
            found += [place for alias in node.names if alias.name == "random"]
    assert found == []


def test_what_tests_share_has_a_file_of_its_own():
    modules = [(place, node.module) for place, node in nodes() if isinstance(node, ast.ImportFrom)]
    assert [(place, module) for place, module in modules if (module or "").startswith("test_")] == []
