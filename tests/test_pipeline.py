"""The corridor from end to end: artefacts, resume, refusals, exit status. A run of the tiny scene takes a few seconds.

Every run is a process of its own, as a user starts it: Taichi holds one program at a time, and a killed process is
really dead.
"""

import csv
import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest
from part21 import read_step
from scipy.spatial import cKDTree

from taichi_edges.corridor.command import print_summary
from taichi_edges.corridor.evaluate import evaluate
from taichi_edges.corridor.findings import CAUSES, DOUBTS, FINDINGS, doubt_of_refine
from taichi_edges.corridor.loading import load_scene
from taichi_edges.corridor.pipeline import STAGES, Run, run_stages
from taichi_edges.errors import UserError
from taichi_edges.evidence.verdict import MARKS
from taichi_edges.files import artefacts
from taichi_edges.files.artefacts import digest_file, remove_unfinished, replacing
from taichi_edges.files.point_cloud import read_oriented_points
from taichi_edges.files.splats import read_gaussians
from taichi_edges.geometry.edge_set import EdgeSet, edges_and_about, read_edges, write_edges
from taichi_edges.geometry.wireframe import read_wireframe
from taichi_edges.progress import PlainProgress, TerminalProgress
from taichi_edges.readers.points import read_points
from taichi_edges.refinement.stage import RefineCounts
from taichi_edges.scene.scene_file import check_scene, parse_yaml
from taichi_edges.seeding.starts import given_points
from taichi_edges.views.cameras import Similarity, invert_pose
from taichi_edges.views.splitting import split_views
from taichi_edges.views.views import Views, read_views, write_views

ROOT = Path(__file__).parent.parent
ARTEFACTS = (
    "views.npz",
    "held_out.npz",
    "gaussians.ply",
    "train_log.csv",
    "points.ply",
    "clusters.npz",
    "edges.json",
    "metrics.json",
    "metrics.csv",
    "edges.ply",
    "edges.obj",
    "edges.dxf",
    "edges.step",
    "overlays.png",
    "run.json",
    "scene.yaml",
    "truth.json",
)
SCENE = """
preset: paper
source: {reader: synthetic, part: block, views: 12, size: 112}
train:
  epochs: 40
  gaussians: 1200
  only_means: 0.375
  means_decay_every: 0.25
  regularize_from: 0.75
  learning_rates: {means: 0.005, scales: 0.001, quaternions: 0.01}
  density: {duplicate_at: [], cull_opacity_at: [0.625], cull_support_at: [0.75]}
filter: {min_opacity: 0.05}
cluster: {max_gap: 0.1, min_points: 5}
fit: {line_tolerance: 0.015}
"""

# Runs run.py with one function of the stage replaced: it kills the process in the middle of its work.
KILLER = """
import os, signal, sys
sys.path.insert(0, {root!r})
import run
from taichi_edges.files import artefacts

def die(*arguments, **options):
    os.kill(os.getpid(), signal.SIGKILL)

def write_half(path, *arguments, **options):
    with artefacts.replacing(path) as unfinished:
        unfinished.write_bytes(b"half a file")
        die()

def patch():
    {patch}

patch()
sys.exit(run.main({arguments!r}))
"""
KILLED_IN = {
    # after the pictures, while views.npz is being written
    "prepare": "from taichi_edges.corridor import edgels_of_views; edgels_of_views.write_views = write_half",
    # after a whole training, when gaussians.ply is half written
    "train": "from taichi_edges.files import splats; splats.write_gaussians = write_half",
    # between points.ply and clusters.npz
    "cluster": "import numpy; numpy.savez_compressed = die",
    "fit": "from taichi_edges.corridor import fit; fit.write_wireframe = write_half",
    "refine": "from taichi_edges.refinement import stage; stage.refine_wireframe = die",
    # between metrics.json and metrics.csv
    "evaluate": "from taichi_edges.corridor import evaluate; evaluate.write_csv = write_half",
    "export": "from taichi_edges.exporters import overlays; overlays.contact_sheet = die",
}


def command(scene, out, *arguments):
    """The command line of a run, without the interpreter and run.py."""
    return [str(scene), "--out", str(out), "--threads", "2", *map(str, arguments)]


def start(arguments, code=None, cwd=ROOT, **environment):
    """Run run.py (or Python `code`) to its end and return the CompletedProcess, with its output as text."""
    environment = {**{key: value for key, value in os.environ.items() if key != "TAICHI_EDGES_DATA"}, **environment}
    head = [sys.executable, "-c", code] if code else [sys.executable, str(ROOT / "run.py")]
    tail = [] if code else arguments
    return subprocess.run(
        [*head, *tail], capture_output=True, check=False, text=True, cwd=cwd, env=environment, timeout=300
    )


def succeed(arguments, **options):
    done = start(arguments, **options)
    assert done.returncode == 0, done.stderr
    return done


def refuse(arguments, **options):
    """The text of the single error line of a run that must end with exit status 2."""
    done = start(arguments, **options)
    assert done.returncode == 2, (done.returncode, done.stderr)
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and done.stderr.splitlines()[-1] == errors[0], done.stderr
    return errors[0]


def contents(folder):
    """{relative path: bytes} of all files in a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def left_behind(folder):
    """Temporary files."""
    return [path.name for path in folder.rglob("*") if "unfinished" in path.name]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """(scene file, folder for --out, CompletedProcess) of an unbroken run. Not to be changed: see `copied`."""
    folder = tmp_path_factory.mktemp("unbroken")
    scene = folder / "tiny.yaml"
    scene.write_text(SCENE)
    done = succeed(command(scene, folder / "runs"))
    return scene, folder / "runs", done


@pytest.fixture
def copied(finished, tmp_path):
    """(scene file, folder for --out, folder of the run) of a copy of the finished run."""
    scene, runs, _ = finished
    shutil.copytree(runs, tmp_path / "runs")
    return scene, tmp_path / "runs", tmp_path / "runs" / "tiny"


class Said:
    """A Progress that keeps what it is told."""

    def __init__(self):
        self.lines = []

    def say(self, text):
        self.lines.append(text)

    def warn(self, text):
        self.lines.append(f"warning: {text}")

    def states(self):
        """{stage: 'up to date' or 'ran'} by the lines said."""
        return {
            line.partition(":")[0]: "up to date" if "up to date" in line else "ran"
            for line in self.lines
            if line.partition(":")[0] in STAGES
        }


def rerun(copied, settings=(), stage=None, until=None, threads=2):
    """Run the copy in this process; good for everything that does not train. Returns the record and what was said."""
    scene, runs, _ = copied
    said = Said()
    config = load_scene(scene, settings=settings)
    record = run_stages(Run(config, runs / config.name, threads=threads, progress=said), stage, until)
    return record, said


def states(ran, skipped):
    return {**dict.fromkeys(skipped, "up to date"), **dict.fromkeys(ran, "ran")}


# -------------------------------------------------------------------------------------------------- units and frames


def write_both_views(folder, views):
    """What the prepare stage writes where no view is held out."""
    for name, some in zip(("views.npz", "held_out.npz"), split_views(views, []), strict=True):
        write_views(folder / name, some)


def test_metrics_do_not_depend_on_the_units_of_the_input(tmp_path):
    """One "mm" is 0.001 of the unit cube: edges 4 input units beside the truth in a box of 2000 are 2 mm off."""
    box = [[-1000.0, -1000, -1000], [1000, 1000, 1000]]
    views = Views(
        ("a",), np.zeros((1, 8, 8), np.uint8), np.eye(3)[None], np.eye(4)[None, :3], ("",), Similarity.of_box(box)
    )
    write_both_views(tmp_path, views)
    ends = np.array([[[-800.0, 0, 0], [800, 0, 0]]])
    write_edges(tmp_path / "truth_in_input_units.json", EdgeSet.of(ends), {})
    write_edges(tmp_path / "edges.json", EdgeSet.of(ends + [0, 4, 0]), {})
    scene = {"source": {"reader": "emap", "path": "x"}, "box": box}
    scene["evaluation"] = {"truth": str(tmp_path / "truth_in_input_units.json")}
    metrics = evaluate(Run(check_scene(scene, "the test"), tmp_path))
    assert metrics["accuracy_mm"] == pytest.approx(2.0, abs=0.05)
    assert metrics["true_length_units"] == pytest.approx(0.8)


def test_without_a_truth_the_edges_are_measured_alone(tmp_path, capsys):
    """In the unit cube, whatever the units of the input."""
    similarity, pose = Similarity(1.0 / 800.0, (0.1, 0.2, 0.3)), np.eye(3, 4)[None]
    views = Views(("v",), np.zeros((1, 4, 4), np.uint8), np.eye(3)[None], pose, ("",), similarity)
    write_both_views(tmp_path, views)
    lines = similarity.to_input([[[0.1, 0.2, 0.3], [0.9, 0.2, 0.3]], [[0.9, 0.2, 0.3], [0.9, 0.5, 0.3]]])
    write_edges(tmp_path / "edges.json", EdgeSet.of(lines), {"units": "input"})
    run = Run(check_scene({"source": {"reader": "nerf", "path": "unused"}}, "test"), tmp_path)
    metrics = evaluate(run)
    assert metrics["ground_truth"] is None and metrics["predicted_length_units"] == pytest.approx(1.1)
    assert (metrics["lines"], metrics["curves"], metrics["edges"], metrics["free_ends"]) == (2, 0, 2, 2)
    with open(tmp_path / "metrics.csv", newline="") as file:
        assert ["free_ends", "2"] in list(csv.reader(file))
    stages = {"prepare": {"facts": {"files": []}}, "evaluate": {"facts": metrics}}
    for stage in stages.values():
        stage |= {"seconds": 1.0, "peak_memory_mib": 1.0}
    print_summary(run, {"stages": stages, "ran": []})
    assert re.search(r"length +1\.10 units\n.*\n +free ends +2\n +ground truth +none\n", capsys.readouterr().out)


def test_everything_exported_is_in_the_frame_of_the_input(finished, tmp_path):
    """The views of the finished run again, as a folder whose units are 2000 to the unit cube, centred at zero."""
    scene, runs, _ = finished
    views = read_views(runs / "tiny/views.npz")
    (tmp_path / "data/maps").mkdir(parents=True)
    frames = []
    for view, name in enumerate(views.names):
        cv2.imwrite(str(tmp_path / f"data/maps/{name}.png"), views.edge_maps[view])
        pose = np.eye(4)
        pose[:3] = invert_pose(views.world_to_camera[view])
        pose[:3, 3] = 2000 * pose[:3, 3] - 1000
        frames.append(
            {"rgb_path": f"{name}.png", "camtoworld": pose.tolist(), "intrinsics": views.intrinsics[view].tolist()}
        )
    (tmp_path / "data/meta_data.json").write_text(json.dumps({"frames": frames}))
    content = parse_yaml(scene.read_text(), scene)
    content["source"] = {"reader": "emap", "path": str(tmp_path / "data"), "edges": "maps", "thin": False}
    content["box"] = [[-1000, -1000, -1000], [1000, 1000, 1000]]
    content["train"]["learning_rates"]["scales"] = 0.0  # so that the Gaussians keep the scale they start with
    (tmp_path / "large.yaml").write_text(json.dumps(content))
    succeed(command(tmp_path / "large.yaml", tmp_path / "runs", "--until", "refine"))
    truth = read_edges(runs / "tiny/truth.json")
    on_edges = cKDTree(2000 * truth.sample(0.002)[0] - 1000)
    _, log_scales, _, _ = read_gaussians(tmp_path / "runs/large/gaussians.ply")
    np.testing.assert_allclose(np.exp(log_scales), 2000 * 0.004, rtol=1e-5)
    points, _ = read_oriented_points(tmp_path / "runs/large/points.ply")
    found = read_edges(tmp_path / "runs/large/edges.json")
    assert np.median(on_edges.query(points)[0]) < 2000 * 0.02  # the tiny run is rough: 0.01 in the unit cube
    assert np.median(on_edges.query(found.sample(10)[0])[0]) < 2000 * 0.02


# ----------------------------------------------------------------------------------------------------- a whole run


def test_cad_files_hold_the_edges_of_the_run(finished):
    import ezdxf

    _, runs, _ = finished
    wireframe = read_wireframe(runs / "tiny/edges.json")
    edges, _ = read_step(runs / "tiny/edges.step")
    document = ezdxf.readfile(runs / "tiny/edges.dxf")
    assert not document.audit().errors and len(document.modelspace()) == len(edges) == len(wireframe)
    for number, (edge, shape) in enumerate(zip(edges, wireframe.shapes, strict=True)):
        assert edge.name.split(",")[0] == f"{shape.kind}_{number}"
        np.testing.assert_allclose(edge.ends, shape.ends, rtol=0, atol=1e-9)
        if shape.kind != "spline":  # whose parameter is another one
            np.testing.assert_allclose(edge.at([0.3, 0.8]), shape.at([0.3, 0.8]), rtol=0, atol=1e-9)


def test_all_artefacts_are_there_and_can_be_read(finished):
    _, runs, _ = finished
    folder = runs / "tiny"
    assert {name for name in ARTEFACTS if not (folder / name).is_file()} == set()
    assert len(list((folder / "overlays").glob("*.png"))) == 4 and len(list((folder / "images").glob("*.png"))) == 12
    views, held_out = read_views(folder / "views.npz"), read_views(folder / "held_out.npz")
    assert len(views) == 11 and len(held_out) == 1 and not set(views.names) & set(held_out.names)
    edges, about = edges_and_about(folder / "edges.json")
    assert len(edges) > 0 and about["frame"] == "input" and about["seed"] == 0
    assert (folder / "gaussians.ply").read_bytes().startswith(b"ply\n")
    log = list(csv.DictReader((folder / "train_log.csv").open()))
    assert [int(row["step"]) for row in log] == [
        *range(50, 440, 50),
        440,
    ]  # 40 epochs of the 11 views that are not held out
    assert left_behind(folder) == []


def test_the_block_is_found(finished):
    """Twelve lines of 0.9 x 0.7 x 0.5; so few views and epochs find most of them."""
    _, runs, _ = finished
    metrics = json.loads((runs / "tiny" / "metrics.json").read_text())
    assert metrics["true_edges"] == 12 and metrics["recall_20mm_percent"] > 80 and metrics["completeness_mm"] < 20


def test_the_record_holds_scene_versions_and_every_stage(finished):
    _, runs, _ = finished
    record = json.loads((runs / "tiny" / "run.json").read_text())
    assert record["scene"]["train"]["epochs"] == 40 and record["scene"]["seed"] == 0
    assert {"taichi_edges", "taichi", "numpy", "scipy"} <= set(record["versions"])
    assert list(record["stages"]) == list(STAGES)
    for stage in record["stages"].values():
        assert stage["seconds"] >= 0 and stage["peak_memory_mib"] > 10 and stage["fingerprint"]
        assert all(re.fullmatch("[0-9a-f]{32}", digest) for digest in stage["outputs"].values())


def test_the_resolved_scene_loads_again(finished):
    scene, runs, _ = finished
    assert load_scene(runs / "tiny" / "scene.yaml") == load_scene(scene)


def test_output_is_a_summary_and_the_progress_goes_to_standard_error(finished):
    _, _, done = finished
    assert "Taichi" not in done.stdout + done.stderr
    assert done.stdout.startswith("tiny: metrics\n") and "F-score at 5 mm" in done.stdout
    exported = "edges.ply, edges.obj, edges.dxf, edges.step, overlays.png"
    assert "results: " in done.stdout and f"edges.json, {exported}" in done.stdout
    lines = done.stderr.splitlines()
    assert lines[0] == "prepare ..." and lines[-1].startswith(f"export: {exported} and 4 pictures")
    assert any(
        re.fullmatch(r"train: \d+ Gaussians after 440 view steps, final loss 0\.\d{4} \(.* s\)", line) for line in lines
    )


def test_every_key_of_the_edges_is_documented(finished):
    _, runs, _ = finished
    content = json.loads((runs / "tiny/edges.json").read_text())
    keys = {*content, *(key for edge in content["edges"] for key in edge)}
    page = (ROOT / "docs/wireframe.md").read_text(encoding="utf-8")
    assert len(keys) > 10 and [key for key in sorted(keys) if f"`{key}`" not in page] == []


def test_every_stage_can_say_what_it_found():
    assert list(FINDINGS) == list(STAGES)
    fit = {"lines": 1, "curves": 2, "loop_clusters": 1, "short_clusters": 3, "degenerate_clusters": 0}
    assert FINDINGS["fit"](fit) == "1 line and 2 curves (1 closed edge); left out: 3 clusters that are too short"
    alone = {"edges": 2, "predicted_length_units": 1.5, "free_ends": 1, "ground_truth": None}
    assert FINDINGS["evaluate"](alone) == "2 edges, 1.50 units long, 1 free end; there is no ground truth"
    seen = {"held_out_views": 3, "held_out_precision_percent": 93.14, "held_out_recall_long_percent": 62.4}
    found = "; 3 views held out: precision 93.1 %, recall 62.4 % of long edges"
    assert FINDINGS["evaluate"](alone | seen).endswith(f"there is no ground truth{found}")
    refined = {"edges": 1, "vertices": 2, **asdict(RefineCounts(duplicates=1, unsupported=2))}
    left_out = "left out: 1 duplicate, 2 edges without support in the images"
    assert FINDINGS["refine"](refined) == f"1 edge, 2 vertices; {left_out}"
    doubted = asdict(RefineCounts(doubted={"blur": 2, "sharpness": 1}))
    left_out = "left out: 1 contour of a rounded surface, 2 rounded or blurred edges"
    assert FINDINGS["refine"]({"edges": 1, "vertices": 2, **doubted}) == f"1 edge, 2 vertices; {left_out}"
    apart = {"edges": 1, "vertices": 2, "contours": 1, **asdict(RefineCounts(joined=2))}
    assert (
        FINDINGS["refine"](apart) == "1 edge, 2 vertices; 2 strokes joined to others; 1 contour in a file of their own"
    )
    anchored = "1 edge, 2 vertices; 2 lines anchored to edges that they meet"
    assert FINDINGS["refine"]({"edges": 1, "vertices": 2, **asdict(RefineCounts(anchored=2))}) == anchored


def test_a_bad_result_is_said_to_be_one_with_its_likely_cause():
    assert list(DOUBTS) == list(CAUSES) and set(DOUBTS) == set(MARKS)
    good = RefineCounts(likely_percent=97.0, shown_percent=90.0, doubted={"blur": 30})
    assert doubt_of_refine(asdict(good)) == doubt_of_refine(asdict(RefineCounts())) == ""
    for worse in ({"likely_percent": 70.0}, {"shown_percent": 50.0}):
        said = doubt_of_refine(asdict(replace(good, doubted={"blur": 3, "sharpness": 30}, **worse)))
        assert "30 contours of rounded surfaces" in said and "\n" not in said
    nothing = doubt_of_refine(asdict(replace(good, shown_percent=50.0, doubted={})))
    assert nothing == "about 3 % of the edges' length is likely wrong, and 50 % of what the pictures show is on no edge"


# --------------------------------------------------------------------------------------- skipping and running again


def test_a_second_run_skips_every_stage_and_changes_nothing(copied):
    scene, runs, folder = copied
    before = contents(folder)
    done = succeed(command(scene, runs))
    assert contents(folder) == before
    assert [line.partition(" (")[0] for line in done.stderr.splitlines()] == [f"{name}: up to date" for name in STAGES]
    assert "(earlier)" in done.stdout


def test_quiet_prints_no_progress(copied):
    scene, runs, _ = copied
    done = succeed(command(scene, runs, "--quiet", "--set", "fit.delta=0.9"))
    assert done.stderr == "" and "F-score" in done.stdout


def test_changing_the_training_runs_from_train_on(copied):
    scene, runs, folder = copied
    before = contents(folder)
    done = succeed(command(scene, runs, "--set", "train.epochs=3"))
    assert "prepare: up to date" in done.stderr
    assert "train again (gaussians.ply: stale: train.epochs was 40, is now 3)" in done.stderr
    assert "cluster again (points.ply: stale: gaussians.ply has changed)" in done.stderr
    after = contents(folder)
    assert after["views.npz"] == before["views.npz"] and after["gaussians.ply"] != before["gaussians.ply"]


def test_changing_the_fit_runs_from_fit_on(copied):
    record, said = rerun(copied, ["fit.delta=0.9", "fit.min_length=0.2"])
    assert said.states() == states(ran=("fit", "refine", "evaluate", "export"), skipped=("prepare", "train", "cluster"))
    assert record["stages"]["fit"]["inputs"]["settings"]["fit"]["delta"] == 0.9
    assert rerun(copied, ["fit.delta=0.9", "fit.min_length=0.2"])[1].states() == states((), STAGES)


def test_a_stage_whose_inputs_come_out_the_same_is_skipped(copied):
    """The cluster stage has to run for its changed setting, but its clusters are the same, so fit need not."""
    _, said = rerun(copied, ["filter.min_views=2.0"])  # of no effect without filter.refine
    assert said.states() == states(
        ran=("cluster",), skipped=("prepare", "train", "fit", "refine", "evaluate", "export")
    )


def test_contours_that_are_asked_for_are_exported_and_others_are_not(copied):
    """The edges are the same, and so is what is evaluated."""
    _, _, folder = copied
    judged, record_file = ["refine.enabled=true"], folder / "run.json"
    rerun(copied, judged)
    before = contents(folder)
    assert "contours.json" not in before
    record, said = rerun(copied, [*judged, "refine.contours=true"])
    assert said.states() == states(ran=("refine", "export"), skipped=("prepare", "train", "cluster", "fit", "evaluate"))
    assert list(record["stages"]["refine"]["outputs"]) == ["edges.json", "contours.json"]
    assert rerun(copied, [*judged, "refine.contours=true"])[1].states() == states((), STAGES)

    with (folder / "contours.json").open("a") as file:
        file.write("\n")
    record["stages"]["refine"]["outputs"]["contours.json"] = digest_file(folder / "contours.json")
    record_file.write_text(json.dumps(record))  # as if refine had found others
    _, said = rerun(copied, [*judged, "refine.contours=true"])
    assert "export again (overlays.png: stale: contours.json has changed)" in said.lines

    _, said = rerun(copied, judged)
    assert said.states()["refine"] == said.states()["export"] == "ran"
    after = contents(folder)
    del before["run.json"], after["run.json"]  # which has the seconds
    assert after == before


def test_another_version_of_a_package_makes_those_stages_stale_that_use_it(copied, monkeypatch):
    """A new ezdxf writes another DXF; nothing is trained again for it."""
    from taichi_edges.corridor import pipeline

    monkeypatch.setattr(pipeline, "version", lambda name: "99.0" if name == "ezdxf" else version(name))
    pipeline.package_versions.cache_clear()
    record, said = rerun(copied)
    pipeline.package_versions.cache_clear()
    assert record["ran"] == ["export"] and record["versions"]["ezdxf"] == "99.0"
    assert any("export again" in line and "the version of ezdxf was" in line for line in said.lines)


def test_stage_starts_there_and_reuses_what_is_before(copied):
    _, _, folder = copied
    gaussians = (folder / "gaussians.ply").stat().st_mtime_ns
    edges = (folder / "edges.json").read_bytes()
    record, said = rerun(copied, stage="cluster")
    assert said.states() == states(ran=("cluster", "fit", "refine", "evaluate", "export"), skipped=())
    assert record["ran"] == ["cluster", "fit", "refine", "evaluate", "export"]
    assert (folder / "gaussians.ply").stat().st_mtime_ns == gaussians
    assert (folder / "edges.json").read_bytes() == edges


def test_until_stops_there(copied):
    record, said = rerun(copied, ["cluster.max_gap=0.08"], until="cluster")
    assert set(said.states()) == {"prepare", "train", "cluster"} and record["ran"] == ["cluster"]


@pytest.mark.parametrize(
    ("until", "results"),
    [
        ("prepare", ["detection.png"]),
        ("cluster", ["detection.png"]),
        ("fit", ["edges_fit.json", "detection.png"]),
        ("refine", ["edges.json", "detection.png"]),
        ("evaluate", ["edges.json", "detection.png"]),
    ],
)
def test_summary_names_the_edges_as_far_as_they_have_come(copied, capsys, until, results):
    scene, _runs, folder = copied
    record, _ = rerun(copied, until=until)
    print_summary(Run(load_scene(scene), folder), record, until)
    assert capsys.readouterr().out.splitlines()[-1] == f"results: {folder}/  ({', '.join(results)})"


def test_stage_and_until_name_one_stage(copied):
    assert rerun(copied, stage="fit", until="fit")[0]["ran"] == ["fit"]


@pytest.mark.parametrize("lost", ["edges.obj", "overlays.png", "points.ply", "metrics.csv", "truth.json"])
def test_a_lost_artefact_is_made_again(copied, lost):
    _, _, folder = copied
    before = (folder / lost).read_bytes()
    (folder / lost).unlink()
    rerun(copied)
    assert (folder / lost).read_bytes() == before


def test_a_hand_edited_artefact_is_noticed_and_made_again(copied):
    _, _, folder = copied
    before = (folder / "edges.json").read_bytes()
    (folder / "edges.json").write_bytes(before.replace(b'"input"', b'"other"'))
    _, said = rerun(copied)
    assert "refine again (edges.json: is not the file that the refine stage wrote)" in said.lines
    assert (folder / "edges.json").read_bytes() == before


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"stages": []}', '{"stages": {"train": 3, "fit": {"seconds": 1}}}']
)
def test_a_damaged_record_is_no_obstacle(copied, content):
    _, _, folder = copied
    (folder / "run.json").write_text(content)
    rerun(copied, until="prepare")
    with pytest.raises(UserError, match="train stage has not finished"):
        rerun(copied, stage="cluster")


# --------------------------------------------------------------------------------------------------------- refusals


def refused(copied, **options):
    with pytest.raises(UserError) as error:
        rerun(copied, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_starting_after_a_missing_artefact_is_refused(copied):
    _, _, folder = copied
    (folder / "gaussians.ply").unlink()
    message = refused(copied, stage="cluster")
    assert message == (
        f"{folder / 'gaussians.ply'}: not there yet, the train stage has not finished; "
        "run again without --stage, or with --stage train"
    )


def test_starting_after_a_stale_artefact_names_the_key_with_old_and_new_value(copied):
    message = refused(copied, stage="cluster", settings=["train.learning_rates.means=0.5", "seed=3"])
    assert "views.npz: stale: seed was 0, is now 3; run again without --stage, or with --stage prepare" in message
    message = refused(copied, stage="cluster", settings=["train.learning_rates.means=0.5"])
    assert "gaussians.ply: stale: train.learning_rates.means was 0.005, is now 0.5;" in message
    assert "points.ply: stale: cluster.theta was 0.8, is now 0.6" in refused(
        copied, stage="fit", settings=["cluster.theta=0.6"]
    )


def test_other_threads_make_the_training_stale(copied):
    assert "gaussians.ply: stale: threads was 2, is now 1" in refused(copied, stage="cluster", threads=1)


def test_starting_after_a_hand_edited_artefact_is_refused(copied):
    _, _, folder = copied
    with open(folder / "gaussians.ply", "ab") as file:
        file.write(b" ")
    assert "gaussians.ply: is not the file that the train stage wrote" in refused(copied, stage="cluster")


def test_a_refusal_changes_no_artefact(copied):
    _, _, folder = copied
    before = {name: content for name, content in contents(folder).items() if name != "scene.yaml"}
    refused(copied, stage="fit", settings=["cluster.theta=0.6"])
    assert {name: content for name, content in contents(folder).items() if name != "scene.yaml"} == before


def test_stage_after_until_is_refused(copied):
    assert "fit comes after train, so there is nothing to run; the order is prepare train" in refused(
        copied, stage="fit", until="train"
    )


def test_a_mistyped_truth_is_refused_before_the_training(copied, tmp_path):
    message = refused(copied, settings=[f"evaluation.truth={tmp_path}/nowhere.ply", "train.epochs=1000000"])
    assert "evaluation.truth: " in message and "does not exist" in message


def test_a_truth_of_no_known_kind_is_refused_before_the_training(copied, tmp_path):
    with pytest.raises(UserError, match="no \\*_features_\\*.yml in it"):
        rerun(copied, [f"evaluation.truth={tmp_path}", "train.epochs=41"])


def test_filters_that_leave_nothing_are_refused_with_counts(copied):
    message = refused(copied, settings=["filter.min_opacity=1"])
    assert "Gaussians passed the filters (" in message and "low opacity" in message and "filter.min_opacity" in message


def test_an_unknown_part_is_refused(copied):
    assert "no part 'blok'; did you mean 'block'?" in refused(copied, settings=["source.part=blok"])


def test_seeds_that_the_source_does_not_have_are_refused(copied):
    assert "train.seeds" in refused(copied, settings=["train.seeds=points"])


def write_cloud(path, points):
    """An ASCII PLY as any other program writes it."""
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    path.write_text(header + "end_header\n" + "".join(f"{x} {y} {z}\n" for x, y, z in points))
    return path


def test_given_points_inside_the_box_become_the_seeds(tmp_path):
    points = [(0.5, 0.5, 0.5), (0.25, 0.5, 0.75), (5.0, 0.5, 0.5)]
    cloud = write_cloud(tmp_path / "cloud.ply", points)
    assert read_points(cloud, [[0, 0, 0], [1, 1, 1]]).tolist() == [list(point) for point in points[:2]]
    assert len(given_points(np.array(points), 2, np.random.default_rng(0))) == 2


def test_given_points_are_refused_when_there_is_none_to_use(copied, tmp_path):
    cloud = write_cloud(tmp_path / "cloud.ply", [(5.0, 0.5, 0.5)])
    empty = write_cloud(tmp_path / "empty.ply", [])
    assert "none of the 1 points" in refused(copied, settings=[f"source.points={cloud}"])
    assert "holds no points" in refused(copied, settings=[f"source.points={empty}"])
    assert "does not exist" in refused(copied, settings=[f"source.points={tmp_path}/nowhere.ply"])


@pytest.mark.slow(reason="starts processes")
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["scenes/nowhere.yaml"], "scenes/nowhere.yaml: No such file or directory"),
        (["scenes"], "scenes: is a folder"),
        (["scenes/abc_00000006.yaml"], "give --data FOLDER or set TAICHI_EDGES_DATA"),
        (["scenes/abc_00000006.yaml", "--data", "run.py"], "--data: run.py is not a folder"),
        (["scenes/abc_00000006.yaml", "--data", "tests"], "tests/abc_nef/00000006 does not exist"),
        (["scenes/demo.yaml", "--out", "run.py"], "cannot be written to (Not a directory); choose another folder"),
        (["scenes/demo.yaml", "--threads", "0"], "--threads 0: must be at least 1"),
        (["scenes/demo.yaml", "--threads", "100000"], "--threads 100000: must be at most 256"),
        (["scenes/demo.yaml", "--threads", "two"], "argument --threads: invalid int value: 'two'"),
        (["scenes/demo.yaml", "--stage", "fti"], "argument --stage: invalid choice"),
        (["scenes/abc_00000006.yaml", "--data", "~nobody-of-this-name"], "--data: ~nobody-of-this-name: '~' and what"),
        (
            ["scenes/demo.yaml", "--set", "fit.delat=1"],
            "--set fit.delat=1: fit.delat: unknown key; did you mean 'delta'?",
        ),
        (["scenes/demo.yaml", "--show", "--until", "train"], "--show needs the edges"),
        (
            ["scenes/demo.yaml", "--stage", "fit", "--until", "train"],
            "fit comes after train, so there is nothing to run",
        ),
    ],
)
def test_mistakes_end_with_status_2_and_one_line(tmp_path, arguments, says):
    out = [] if "--out" in arguments else ["--out", str(tmp_path)]
    assert says in refuse([*arguments, *out])
    assert left_behind(tmp_path) == []


def test_a_data_root_that_is_no_folder_is_named_by_its_variable(tmp_path):
    arguments = ["scenes/abc_00000006.yaml", "--out", str(tmp_path)]
    assert "TAICHI_EDGES_DATA: /nowhere is not a folder" in refuse(arguments, TAICHI_EDGES_DATA="/nowhere")


def test_a_device_that_is_not_there_is_refused(copied):
    scene, runs, _ = copied
    if shutil.which("nvidia-smi"):
        pytest.skip("this machine has an NVIDIA driver")
    message = refuse([str(scene), "--out", str(runs), "--arch", "cuda"])
    assert "--arch cuda: this machine offers Taichi no cuda device; use cpu" in message


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="only Linux tells by a variable that there is no display"
)
def test_show_without_a_display_says_what_to_open_instead(copied):
    scene, runs, _ = copied
    message = refuse(command(scene, runs, "--show"), DISPLAY="", WAYLAND_DISPLAY="")
    assert "no display" in message and "edges.ply" in message


def test_a_closed_pipe_is_no_error(copied):
    scene, runs, _ = copied
    code = (
        "import subprocess, sys\n"
        f"run = subprocess.Popen([sys.executable, {str(ROOT / 'run.py')!r}, *{command(scene, runs)!r}], "
        "stdout=subprocess.PIPE, "
        "stderr=subprocess.PIPE)\nrun.stdout.close()\nsys.stderr.write(run.stderr.read().decode())\nsys.exit(run.wait())"
    )
    done = start([], code=code)
    assert done.returncode == 0 and "Traceback" not in done.stderr and "Exception" not in done.stderr


# ------------------------------------------------------------------------------------------- kills and repetitions


def kill_in(stage, arguments):
    """Run until the process kills itself in `stage`."""
    code = KILLER.format(root=str(ROOT), patch=KILLED_IN[stage], arguments=arguments)
    done = start([], code=code)
    assert done.returncode == -signal.SIGKILL, (stage, done.returncode, done.stderr)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_a_run_killed_in_every_stage_and_resumed_each_time_gives_the_same_edges(finished, tmp_path):
    scene, runs, _ = finished
    arguments, folder = command(scene, tmp_path), tmp_path / "tiny"
    unbroken = contents(runs / "tiny")
    for number, stage in enumerate(STAGES):
        kill_in(stage, arguments)
        record = folder / "run.json"
        done = list(json.loads(record.read_text())["stages"]) if record.exists() else []
        assert done == list(STAGES)[:number]  # the killed stage does not count as finished
        for name in [artefact for each in done for artefact in STAGES[each].writes]:
            if name != "train_log.csv":  # it holds seconds
                assert (folder / name).read_bytes() == unbroken[name], (stage, name)
    succeed(arguments)
    assert (folder / "edges.json").read_bytes() == unbroken["edges.json"]
    assert (folder / "gaussians.ply").read_bytes() == unbroken["gaussians.ply"]
    assert left_behind(folder) == []


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_a_kill_leaves_a_finished_run_of_other_settings_noticed(copied):
    """Killed while it replaces older artefacts: a mixture of two runs must not pass for either."""
    scene, runs, folder = copied
    before = (folder / "edges.json").read_bytes()
    kill_in("evaluate", command(scene, runs, "--set", "fit.min_length=0.6"))
    rerun(copied)  # the first settings again
    assert (folder / "edges.json").read_bytes() == before
    assert (
        json.loads((folder / "run.json").read_text())["stages"]["fit"]["inputs"]["settings"]["fit"]["min_length"]
        == 0.01
    )


def test_one_seed_gives_the_same_edges_and_another_seed_others(finished, tmp_path):
    """The killed run above is the second run with one seed; here the prepared views come anew with another."""
    scene, runs, _ = finished
    succeed(command(scene, tmp_path, "--seed", "1", "--until", "refine"))
    other, first = tmp_path / "tiny" / "edges.json", runs / "tiny" / "edges.json"
    assert other.read_bytes() != first.read_bytes()
    assert edges_and_about(other)[1]["seed"] == 1
    assert (tmp_path / "tiny" / "gaussians.ply").read_bytes() != (runs / "tiny" / "gaussians.ply").read_bytes()


# ------------------------------------------------------------------------------------------------------------- speed


def test_what_is_up_to_date_or_mistaken_waits_for_no_library(copied):
    """Neither SciPy nor OpenCV, Open3D and Taichi are imported before a stage needs them."""
    scene, runs, _ = copied
    code = (
        "import sys, run; status = run.main(sys.argv[1:]); "
        "print('imported:', *{'scipy', 'cv2', 'open3d', 'taichi', 'rich'} & sys.modules.keys()); sys.exit(status)"
    )
    for settings, status in ((), 0), (("--set", "train.epoch=3"), 2):
        arguments = [sys.executable, "-c", code, *command(scene, runs, *settings)]
        done = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout.splitlines()[-1]) == (status, "imported:")


def test_views_are_read_once_and_again_when_they_have_changed(copied):
    _, _, folder = copied
    path, before = folder / "views.npz", digest_file(folder / "views.npz")
    views = read_views(path)
    assert read_views(path) is views and digest_file(path) == before
    with pytest.raises(ValueError, match="read-only"):
        views.edge_maps[0, 0, 0] = 1
    turned = Views(views.names, 255 - views.edge_maps, views.intrinsics, views.world_to_camera, views.image_paths)
    write_views(path, turned)
    np.testing.assert_array_equal(read_views(path).edge_maps, turned.edge_maps)
    assert digest_file(path) != before


# -------------------------------------------------------------------------------------------------------- progress


@pytest.mark.parametrize("quiet", [False, True])
def test_warnings_are_shown_even_when_quiet(capsys, quiet):
    progress = PlainProgress(quiet)
    progress.say("information")
    progress.warn("trouble")
    assert capsys.readouterr().err == ("" if quiet else "information\n") + "warning: trouble\n"


def test_plain_progress_tells_share_and_time_left(capsys, monkeypatch):
    clock = iter([0.0, 0.0, 5.0, 15.0, 15.0])  # enter, start, a step too soon to tell, a step worth a line, its pace
    monkeypatch.setattr("taichi_edges.progress.time.monotonic", lambda: next(clock))
    with PlainProgress().track("train", 4) as report:
        report(1, "loss 0.5")
        report(3, "loss 0.4")
    assert capsys.readouterr().err == "  train: 75 %, about 5 s left, loss 0.4\n"


def test_terminal_progress_prints_texts_as_they_are(capsys):
    progress = TerminalProgress()
    text = "/a/very/long/path/" + 20 * "[bold]:warning:/" + "file.json"
    progress.say(text)
    with progress.track("train", 2) as report:
        report(1, "half")
    assert text in capsys.readouterr().err.replace("\r", "")


# -------------------------------------------------------------------------------------------------- temporary files


def test_a_failed_write_leaves_the_old_file_and_no_temporary_one(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), replacing(path) as unfinished:
        unfinished.write_text("half")
        raise RuntimeError
    assert [each.name for each in tmp_path.iterdir()] == ["file.txt"] and path.read_text() == "old"


def test_temporary_files_of_the_dead_are_removed_and_those_of_the_living_stay(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    living = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        names = [f".views.{process.pid}.unfinished.npz" for process in (dead, living)]
        for name in [*names, "views.npz"]:
            (tmp_path / name).touch()
        remove_unfinished(tmp_path)
        assert {path.name for path in tmp_path.iterdir()} == {names[1], "views.npz"}
    finally:
        living.communicate(b"\n")


# --------------------------------------------------------------------------------------------------- two runs at once

HOLDER = """
import sys
from pathlib import Path
from taichi_edges.files.artefacts import locked

with locked(Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(copied):
    """A process that holds the lock of the copied run, as another run would."""
    arguments = [sys.executable, "-c", HOLDER, str(copied[2])]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout.readline() == "locked\n"
        yield process
        process.kill()


def test_a_second_run_into_the_same_folder_is_refused(copied, holder):
    message = refused(copied)
    assert f"another run, process {holder.pid}, is writing into this folder; wait for it" in message


def test_the_lock_of_a_dead_run_is_taken_over(copied, holder):
    holder.kill()
    holder.wait()
    _, said = rerun(copied)
    assert said.states() == states([], STAGES)


@pytest.mark.parametrize(("number", "holds"), [(errno.ENOLCK, True), (errno.EIO, False)])
def test_a_file_system_that_knows_no_locks_is_no_obstacle(tmp_path, monkeypatch, number, holds):
    def fail(descriptor, blocking):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(artefacts, "lock_descriptor", fail)
    if holds:
        with artefacts.locked(tmp_path):
            assert (tmp_path / ".lock").read_text() == f" {os.getpid()}\n"
        assert (tmp_path / ".lock").read_text() == ""
    else:
        with pytest.raises(OSError, match=os.strerror(number)):
            artefacts.locked(tmp_path).__enter__()


def test_show_without_a_display_is_refused_before_anything_is_done(tmp_path):
    message = refuse(command("scenes/demo.yaml", tmp_path, "--show"), DISPLAY="", WAYLAND_DISPLAY="")
    assert "there is no display" in message
    assert list(tmp_path.iterdir()) == []
