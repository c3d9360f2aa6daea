"""The corridor with the default preset: maps calibrated, points refined, edges where they are, the same every time."""

import json
from functools import lru_cache

import pytest

from taichi_edges.corridor.loading import load_scene
from taichi_edges.corridor.pipeline import Run, run_stages
from taichi_edges.files.splats import read_strokes

pytestmark = pytest.mark.slow(reason="runs the corridor with the default preset")

SCENE = "source: {{reader: synthetic, part: {part}, views: 16, size: 240, detector: {detector}}}\n"


def run_scene(folder, part, detector, threads=2):
    """The finished run's folder and what `run.json` holds."""
    folder.mkdir()
    (folder / "scene.yaml").write_text(SCENE.format(part=part, detector=detector))
    run = Run(load_scene(folder / "scene.yaml"), folder / "run", threads=threads)
    run.folder.mkdir()
    return run.folder, run_stages(run)


@pytest.fixture(scope="module")
def run_once(tmp_path_factory):
    """run_once(part, detector) -> folder and record of a run that tests share."""
    return lru_cache(lambda *scene: run_scene(tmp_path_factory.mktemp("shared") / "one", *scene))


@pytest.mark.parametrize(("part", "detector"), [("wave", "auto"), ("block", "subpixel")])
def test_edges_are_within_a_third_of_a_pixel_of_the_truth(run_once, part, detector):
    folder, record = run_once(part, detector)
    metrics = json.loads((folder / "metrics.json").read_text())
    # A pixel is some 8 mm here. Completeness has a floor of 2 mm, from the spacing of the samples.
    assert metrics["accuracy_mm"] < 4.0 and metrics["completeness_mm"] < 4.0
    assert metrics["f_score_10mm_percent"] > 95
    facts = record["stages"]["prepare"]["facts"]
    assert ("calibration" in facts) == (detector == "auto")
    assert {"detection.png", "truth.json"} <= set(facts["files"])
    strokes = read_strokes(folder / "gaussians.ply")
    assert len(strokes) == record["stages"]["train"]["facts"]["gaussians"] and (strokes[1:] >= strokes[:-1]).all()


def test_the_same_seed_gives_the_same_edges_bit_for_bit(run_once, tmp_path):
    (one, _), (other, _) = run_once("wave", "auto"), run_scene(tmp_path / "other", "wave", "auto")
    for artefact in ("edges.json", "points.ply", "gaussians.ply"):
        assert (one / artefact).read_bytes() == (other / artefact).read_bytes()
