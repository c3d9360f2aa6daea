"""The documents are true where that can be checked: the paths, links and keys that they name are there."""

import re
from pathlib import Path

import pytest

from taichi_edges.scene.settings import SceneConfig

ROOT = Path(__file__).parent.parent
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "benchmarks").glob("*.md")]
CODE = [*(ROOT / "taichi_edges").rglob("*.py"), *(ROOT / "benchmarks").glob("*.py")]
PLACES = (ROOT, ROOT / "taichi_edges")
FOLDERS = sorted(path.name for place in PLACES for path in place.iterdir() if path.is_dir())
OURS = re.compile(rf"(?<![\w/.-])((?:{'|'.join(FOLDERS)})/(?:\w+/)*\w+\.(?:py|md|yaml|c))\b")  # no file of others
KEY = re.compile(rf"\b((?:{'|'.join(SceneConfig.model_fields)})(?:\.[a-z][a-z_]*)+)")


def keys_of(section, prefix=""):
    """Every key of the scene, sections too: 'train', 'train.steps', ..."""
    for name, field in section.model_fields.items():
        yield prefix + name
        if hasattr(field.annotation, "model_fields"):
            yield from keys_of(field.annotation, f"{prefix}{name}.")


def not_there(path):
    """Files of the project that a text names and that do not exist."""
    named = OURS.findall(path.read_text(encoding="utf-8"))
    return [name for name in named if not any((place / name).exists() for place in PLACES)]


def is_there(page, link):
    """Whether a link of a page, 'file', 'file#heading' or '#heading', leads somewhere."""
    file, _, heading = link.partition("#")
    target = page.parent / file if file else page
    if not heading or not target.is_file():
        return target.exists()
    headings = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), re.MULTILINE)
    return heading in [re.sub(r"[^\w\- ]", "", text.lower()).replace(" ", "-") for text in headings]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_a_page_names_is_there(path):
    text = path.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)]+)", text) if not link.startswith("http")]
    keys, known = KEY.findall(" ".join(re.findall(r"`([^`]+)`", text))), set(keys_of(SceneConfig))
    assert [link for link in links if not is_there(path, link)] == []
    assert not_there(path) == []
    assert (
        path.name == "CHANGELOG.md" or [key for key in keys if key not in known] == []
    )  # it names those that are gone


def test_files_that_the_code_names_are_there():
    assert {str(path): not_there(path) for path in CODE if not_there(path)} == {}
