"""What is added to one of the tables must be known elsewhere, too: each test names the place that has been forgotten.

CONTRIBUTING.md lists these places for a reader, a detector, an exporter and a part.
"""

import re
from pathlib import Path
from typing import get_args

import pytest

from taichi_edges.corridor.arguments import make_parser
from taichi_edges.corridor.pipeline import ARCHS
from taichi_edges.corridor.stages import STAGES
from taichi_edges.detectors import DETECTORS
from taichi_edges.exporters import EXPORTERS
from taichi_edges.kernels.device import DEVICES
from taichi_edges.readers import READERS
from taichi_edges.scene.presets import PRESETS, SCALES, SCALES_OF_READERS
from taichi_edges.scene.settings import WITH_POINTS, SourceConfig
from taichi_edges.synthetic.hard_parts import HARD_PARTS
from taichi_edges.synthetic.parts import PARTS

DOCS = Path(__file__).parent.parent / "docs"


def choices(key):
    """What the scene's `source` section takes for a key."""
    return set(get_args(SourceConfig.model_fields[key].annotation))


def page(name):
    """The text of a page of the docs."""
    return (DOCS / name).read_text(encoding="utf-8")


def test_a_scene_can_ask_for_every_reader_and_detector():
    assert choices("reader") == {*READERS, "auto", "synthetic"}
    assert choices("detector") == {*DETECTORS, "auto"}


def test_presets_name_only_readers_that_there_are():
    assert set(SCALES_OF_READERS) | set(WITH_POINTS) <= {*READERS, "auto"}


def test_the_command_line_takes_what_the_tables_hold():
    offered = re.findall(r"--(\w+) \{([\w,]+)\}", " ".join(make_parser().format_usage().split()))
    choices = {option: set(values.split(",")) for option, values in offered}
    assert choices == {
        "stage": set(STAGES),
        "until": set(STAGES),
        "preset": set(PRESETS),
        "scale": set(SCALES),
        "arch": set(ARCHS),
    }
    assert set(ARCHS) == set(DEVICES)


@pytest.mark.parametrize("name", READERS)
def test_every_reader_is_documented(name):
    layouts, _, keys = page("inputs.md").partition("## Keys of the files")
    assert f"\n| `{name}` |" in layouts and f"`{name}`" in keys


@pytest.mark.parametrize("name", DETECTORS)
def test_every_detector_is_documented(name):
    assert f"`{name}`" in page("inputs.md").partition("## Edge maps and detectors")[2].partition("\n## ")[0]


@pytest.mark.parametrize("suffix", EXPORTERS)
def test_every_exporter_is_documented(suffix):
    assert f"`edges{suffix}`" in page("outputs.md")


@pytest.mark.parametrize("name", PARTS)
def test_every_part_is_documented(name):
    assert f"`{name}`" in page("inputs.md").partition("## Synthetic parts")[2]
    assert name not in HARD_PARTS or f"| {name} " in page("wireframe.md")
