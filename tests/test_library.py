"""The project as a library and as an installed command: from any folder, with strings for paths, light to import."""

import configparser
import json
import ntpath
import subprocess
import sys
from dataclasses import FrozenInstanceError
from importlib import import_module
from pathlib import Path, PureWindowsPath
from types import SimpleNamespace

import numpy as np
import pytest
from told import Told

import taichi_edges
from taichi_edges import Run, UserError, evaluate, load_scene, read_edges, read_wireframe, reconstruct, run_stages
from taichi_edges.corridor import machine, pipeline, prepare
from taichi_edges.corridor.stages import STAGES, function_of
from taichi_edges.files.splats import read_strokes
from taichi_edges.scene.paths import DATA_ROOT, shipped_scenes

ROOT = Path(__file__).parent.parent
TINY = """
preset: paper
source: {reader: synthetic, part: block, views: 6, size: 96}
train: {epochs: 3, gaussians: 300, seeds: lift}
filter: {min_opacity: 0.0, min_support: 0.0}
cluster: {max_gap: 0.3, min_points: 3}
"""


def python(*arguments, cwd, **environment):
    """The finished process of an interpreter that finds the package but is not in its folder."""
    command = [sys.executable, *map(str, arguments)]
    environment = {"PYTHONPATH": str(ROOT), "PATH": "", "HOME": str(cwd), **environment}
    return subprocess.run(command, capture_output=True, check=False, text=True, cwd=cwd, env=environment, timeout=120)


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """An empty working folder, and no data root."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(DATA_ROOT, raising=False)
    return tmp_path


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """(scene file as text, folder for `out` as text, Reconstruction)."""
    folder = tmp_path_factory.mktemp("library")
    (folder / "tiny.yaml").write_text(TINY)
    scene, out = str(folder / "tiny.yaml"), str(folder / "results")
    return scene, out, reconstruct(scene, out=out, threads=2, seed=3, fit={"min_length": 0.02}, name="block")


# ----------------------------------------------------------------------------------------------------- the interface


def test_the_package_is_light_and_brings_its_interface_when_asked(elsewhere):
    code = "import sys, taichi_edges; print(*[name for name in sys.modules if name.startswith(('numpy', 'taichi'))])"
    assert python("-c", code, cwd=elsewhere).stdout.split() == ["taichi_edges"]
    assert set(taichi_edges.__all__) <= set(dir(taichi_edges))
    for name in taichi_edges.__all__:
        assert getattr(taichi_edges, name).__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'recontruct'"):
        taichi_edges.recontruct  # noqa: B018


def test_one_call_leads_from_a_scene_to_its_wireframe(tiny):
    _, out, found = tiny
    assert found.folder == Path(out) / "block" and (found.folder / "edges.step").is_file()
    assert len(found.wireframe) == found.metrics["edges"] > 0 and found.metrics["true_edges"] == 12
    assert found.record["ran"] == list(STAGES)
    config = found.run.config
    assert (config.seed, config.fit.min_length, config.fit.line_tolerance) == (3, 0.02, 0.005)
    with pytest.raises(FrozenInstanceError):
        found.metrics = None


def test_gaussians_that_were_culled_and_copied_are_on_no_strokes(tiny):
    """The paper's schedule; who is left has no place in their order."""
    assert read_strokes(tiny[2].folder / "gaussians.ply") is None


def test_a_second_call_reuses_what_the_first_has_written_and_reports_as_the_command_does(tiny, capsys):
    scene, out, first = tiny
    again = reconstruct(scene, out=out, threads=2, seed=3, name="block", **{"fit.min_length": 0.02})
    assert again.record["ran"] == [] and again.metrics == first.metrics
    assert len(capsys.readouterr().err.splitlines()) == len(STAGES)
    part = reconstruct(
        scene, "fit", "fit", out=out, threads=2, seed=3, name="block", fit={"min_length": 0.02}, quiet=True
    )
    assert part.record["ran"] == ["fit"] and part.wireframe is None and part.metrics is None
    assert capsys.readouterr().err == ""


def test_a_run_takes_strings_makes_its_folder_and_reports(elsewhere, capsys):
    Path("tiny.yaml").write_text(TINY)
    run = Run(load_scene("tiny.yaml"), "deep/results", threads=2)
    assert run.folder == Path("deep/results") and run.data_root is None
    record = run_stages(run, until="prepare")
    assert record["ran"] == ["prepare"] and Path("deep/results/views.npz").is_file()
    assert capsys.readouterr().err.startswith("prepare ...\n")
    told = Told()
    run_stages(Run(run.config, "deep/results", threads=2, progress=told), until="prepare")
    assert told.notes[0].startswith("prepare: up to date") and capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"start": "fti"}, "^start fti: there is no such stage; there is prepare, .*export; did you mean 'fit'?"),
        ({"until": "exprot"}, "^until exprot: there is no such stage; .*; did you mean 'export'?"),
        ({"arch": "gpu"}, "^arch gpu: there is no such device; there is cpu, cuda, vulkan"),
        ({"start": ["fit"]}, r"^start \['fit'\]: there is no such stage"),
        (
            {"start": "refine", "until": "fit"},
            "^refine comes after fit, so there is nothing to run; the order is prepare",
        ),
        (
            {"stage": "fit"},
            "stage='fit': stage: unknown key; the stage to start with is .* the argument start from Python",
        ),
        ({"show": True}, "show=True: show: unknown key; the window is opened by the command line alone, with --show"),
        ({"threads": 0}, "^threads 0: must be at least 1"),
        ({"threads": "4"}, "^threads '4': must be a whole number"),
        ({"threads": 2.5}, "^threads 2.5: must be a whole number"),
        ({"out": None}, "^out: must be a path, not None"),
        ({"data": 3}, "^data: must be a path, not 3"),
        ({"preset": "papre"}, "^preset papre: there is no such preset; .*; did you mean 'paper'?"),
        ({"train": {"step": 3}}, r"train={'step': 3}: train.step: unknown key; did you mean 'steps'\?"),
        ({"train.steps": "many"}, r"train.steps='many': train.steps: must be a whole number"),
        ({"steps": 3}, "steps=3: steps: unknown key; did you mean 'train.steps'?"),
        ({"seed": -1}, "^seed -1: seed: must be at least 0"),
        ({"data": "nowhere"}, "^data: nowhere is not a folder"),
    ],
)
def test_mistakes_are_errors_of_the_user_and_leave_nothing_behind(elsewhere, wrong, says):
    with pytest.raises(UserError, match=says):
        reconstruct("demo", **wrong)
    assert list(elsewhere.iterdir()) == []


def test_what_is_no_scene_and_no_run_is_refused_at_once(elsewhere):
    for nothing in (None, 3):
        with pytest.raises(UserError, match=f"^scene: must be a path, not {nothing}$"):
            reconstruct(nothing)
    with pytest.raises(UserError, match="^config: must be what load_scene returns, not 'demo'$"):
        Run("demo", "results")
    with pytest.raises(UserError, match="^folder: must be a path, not None$"):
        Run(load_scene("demo"), None)
    with pytest.raises(UserError, match="^data_root: nowhere is not a folder"):
        Run(load_scene("demo"), "results", data_root="nowhere")
    assert type(Run(load_scene("demo"), "results", threads=np.int64(2)).threads) is int


def test_files_inside_the_run_are_called_the_same_on_every_system(monkeypatch):
    folder = PureWindowsPath("C:/runs/demo")
    assert pipeline.file_label(SimpleNamespace(folder=folder), folder / "images" / "a.png") == "images/a.png"
    assert pipeline.file_label(SimpleNamespace(folder=folder), PureWindowsPath("C:/data/a.png")) == "C:/data/a.png"
    monkeypatch.setattr(prepare, "Path", PureWindowsPath)
    monkeypatch.setattr(prepare, "os", SimpleNamespace(path=ntpath))
    assert prepare.relative_path(r"C:\runs\demo\images\a.png", str(folder)) == "images/a.png"
    assert (
        prepare.relative_path(r"C:\data\a.png", str(folder)) == r"C:\data\a.png"
        and prepare.relative_path("", "C:/") == ""
    )


def test_settings_may_be_sections_or_keys(elsewhere):
    nested = load_scene("demo", settings={"train": {"epochs": 3}, "source": {"views": 5}})
    assert nested == load_scene("demo", settings=["train.epochs=3", "source.views=5"])
    assert nested == load_scene("demo", settings={"train.epochs": 3, "source.views": 5})
    assert (nested.train.epochs, nested.train.steps) == (3, 0)
    with pytest.raises(UserError, match="a preset brings many values with it; give it as the argument preset"):
        load_scene("demo", settings={"preset": "paper"})


def test_the_data_root_of_the_environment_counts(elsewhere, monkeypatch):
    (elsewhere / "data/shed").mkdir(parents=True)
    (elsewhere / "data/shed/meta_data.json").write_text(json.dumps({"frames": [{}, {}]}))
    (elsewhere / "shed.yaml").write_text("source: {path: shed}\n")
    with pytest.raises(UserError, match="give --data FOLDER or set TAICHI_EDGES_DATA"):
        reconstruct("shed.yaml")
    monkeypatch.setenv(DATA_ROOT, "data")
    run = Run(load_scene("shed.yaml"), "results", progress=Told())
    assert run.data_root == elsewhere / "data"
    with pytest.raises(
        UserError, match="a frame without rgb_path"
    ):  # so far it comes, by the reader that it recognises
        run_stages(run)
    assert run.progress.notes == [f"{elsewhere / 'data/shed'}: read as an EMAP scene (meta_data.json, 2 images)"]
    monkeypatch.setenv(DATA_ROOT, "nowhere")
    with pytest.raises(UserError, match="TAICHI_EDGES_DATA: nowhere is not a folder"):
        Run(run.config, "results")
    assert Run(run.config, "results", data_root="data").data_root == elsewhere / "data"


# ---------------------------------------------------------------------------------------------- scenes that come along


def test_scenes_that_come_along_are_found_by_name(elsewhere):
    assert set(shipped_scenes()) == {path.stem for path in (ROOT / "scenes").glob("*.yaml")}
    assert load_scene("demo") == load_scene("demo.yaml") == load_scene(ROOT / "scenes/demo.yaml")
    for name, says in (
        ("scenes/demo.yaml", "No such file or directory; for the scene that comes along give its name alone: demo"),
        ("dmeo", "dmeo: No such file or directory; did you mean 'demo'?"),
        ("abc_4926", "did you mean 'abc_00004926'?"),
    ):
        with pytest.raises(UserError) as refused:
            load_scene(name)
        assert says in str(refused.value)


def test_what_lies_in_the_working_folder_comes_first(elsewhere):
    (elsewhere / "demo.yaml").write_text("source: {reader: synthetic, part: wave}\n")
    assert load_scene("demo.yaml").source.part == "wave" and load_scene("demo").source.part == "demo"
    (elsewhere / "demo").mkdir()
    assert load_scene("demo").source.path == str(elsewhere / "demo")


def test_the_results_of_a_scene_in_the_working_folder_are_not_its_source(elsewhere):
    small = {"source.part": "block", "source.views": 3, "source.size": 64, "out": ".", "threads": 2, "quiet": True}
    first = reconstruct("demo", until="prepare", **small)
    assert (elsewhere / "demo/run.json").is_file()
    again = reconstruct("demo", until="prepare", **small)
    assert again.run.config == first.run.config and again.record["ran"] == []
    (elsewhere / "mine").mkdir()
    (elsewhere / "mine/run.json").write_text("{}")
    assert load_scene("mine").source.path == str(elsewhere / "mine")  # no scene that comes along


# ------------------------------------------------------------------------------------------------------------- scores


def test_an_edge_file_is_scored_as_its_run_was(tiny):
    _, _, found = tiny
    truth, metrics = str(found.folder / "truth.json"), found.metrics
    path = found.folder / "edges.json"
    for edges in (str(path), path, found.wireframe, read_edges(path), read_wireframe(path)):
        scores = evaluate(edges, truth)
        assert scores == {key: value for key, value in metrics.items() if not key.startswith("held_out")}
    assert read_wireframe(found.folder / "edges.json").edge_set().lengths.sum() == pytest.approx(
        found.wireframe.edge_set().lengths.sum()
    )


def test_scores_do_not_depend_on_the_units_of_the_frame_where_its_box_is_given(tiny, tmp_path):
    _, _, found = tiny
    edges = read_edges(found.folder / "edges.json")
    truth = read_edges(found.folder / "truth.json")
    large, path = edges.transformed(lambda points: 2000 * points - 1000), tmp_path / "truth.json"
    truth = truth.transformed(lambda points: 2000 * points - 1000)
    content = {"lines_end_pts": truth.lines.tolist(), "curves_ctl_pts": truth.curves.tolist()}
    path.write_text(json.dumps(content))
    scores = evaluate(large, path, box=[[-1000, -1000, -1000], [1000, 1000, 1000]])
    for key in ("accuracy_mm", "completeness_mm", "predicted_length_units"):
        assert scores[key] == pytest.approx(found.metrics[key], rel=1e-3)
    for box in (
        [[0, 0, 0], [1, 1, 0]],
        [1, 2, 3],
        np.zeros((2, 3)),
        "unit",
        [[0, 0, 0], [1, 1]],
        [[0] * 3, [np.inf] * 3],
    ):
        with pytest.raises(UserError, match="box: must be two finite corners"):
            evaluate(large, path, box)


def test_what_are_no_edges_and_no_truth_is_refused(tiny, tmp_path):
    _, _, found = tiny
    truth = found.folder / "truth.json"
    with pytest.raises(
        UserError, match="^edges: must be the path of an edge file, an EdgeSet or a Wireframe, not list$"
    ):
        evaluate([[0, 0, 0], [1, 1, 1]], truth)
    with pytest.raises(UserError, match="^truth: must be a path, not None$"):
        evaluate(found.wireframe, None)
    path = tmp_path / "nan.json"
    path.write_text('{"lines_end_pts": [[[0, 0, 0], [1, NaN, 1]]], "curves_ctl_pts": []}')
    with pytest.raises(UserError, match=f"^{path}: line 0: its points are not finite numbers; drop it before scoring$"):
        evaluate(path, truth)


def test_edges_and_truth_may_lie_at_home(tiny, monkeypatch):
    _, _, found = tiny
    monkeypatch.setenv("HOME", str(found.folder))
    monkeypatch.setenv("USERPROFILE", str(found.folder))
    assert evaluate("~/edges.json", "~/truth.json")["edges"] == found.metrics["edges"]
    assert len(read_edges("~/edges.json")) > 0 and len(read_wireframe("~/edges.json")) == len(found.wireframe)


def test_a_truth_with_a_frame_of_its_own_takes_no_box(tiny, tmp_path):
    _, _, found = tiny
    line = {"type": "Line", "sharp": True, "vert_indices": [0, 1], "vert_parameters": [0.0, 1.0]}
    line |= {"location": [0.0, 0.0, 0.0], "direction": [1.0, 0.0, 0.0]}
    (tmp_path / "1_features_0.yml").write_text(f"curves: {json.dumps([line])}\n")
    (tmp_path / "stats.json").write_text(json.dumps({"1": {"bbox": [0, 0, 0, 1, 1, 1, 1, 1, 1]}}))
    assert evaluate(found.wireframe, tmp_path)["true_edges"] == 1
    with pytest.raises(UserError, match="box: .* is an ABC folder, whose frame is normalised; leave box out"):
        evaluate(found.wireframe, tmp_path, box=[[0, 0, 0], [2, 2, 2]])


# -------------------------------------------------------------------------------------------------------- the command


@pytest.mark.parametrize("command", [[ROOT / "run.py"], ["-m", "taichi_edges"]])
def test_the_version_is_told_at_once_from_any_folder(elsewhere, command):
    done = python(*command, "--version", cwd=elsewhere)
    assert (done.returncode, done.stdout) == (0, f"taichi-edges {taichi_edges.__version__}\n"), done.stderr
    done = python(*command, "demo", "--stage", "fti", cwd=elsewhere)
    name = "python -m taichi_edges" if command[0] == "-m" else "run.py"
    assert done.returncode == 2 and done.stderr.endswith(f"; see {name} --help\n")


def test_the_command_line_is_read_without_any_library(elsewhere):
    code = """
import sys
from taichi_edges.corridor.arguments import parse_arguments
assert parse_arguments(["demo", "--until", "fit"]).until == "fit"
print(*{"numpy", "pydantic", "yaml", "psutil", "rich"} & sys.modules.keys())
"""
    done = python("-c", code, cwd=elsewhere)
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr


def test_every_stage_is_a_function_in_a_file_of_its_name():
    for name in STAGES:
        assert function_of(name).__module__ == f"taichi_edges.corridor.{name}"


def test_the_installed_command_is_the_one_of_run_py():
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    command, _, place = setup["options.entry_points"]["console_scripts"].strip().partition(" = ")
    module, _, function = place.partition(":")
    assert command == "taichi-edges" and callable(getattr(import_module(module), function))
    assert f"from {module} import {function}" in (ROOT / "run.py").read_text(encoding="utf-8")


def test_what_is_installed_holds_every_file_and_the_scenes(elsewhere):
    place = elsewhere / "installed"
    done = python("setup.py", "--quiet", "build_py", "--build-lib", place, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    installed = {str(path.relative_to(place)) for path in place.rglob("*") if path.is_file()}
    assert {str(path.relative_to(ROOT)) for path in (ROOT / "taichi_edges").rglob("*.py")} <= installed
    assert {f"taichi_edges/scenes/{name}.yaml" for name in shipped_scenes()} <= installed
    code = "from taichi_edges import load_scene; print(load_scene('demo').source.part, load_scene.__code__.co_filename)"
    done = python("-c", code, cwd=elsewhere, PYTHONPATH=str(place))
    assert done.stdout == f"demo {place / 'taichi_edges/corridor/loading.py'}\n", done.stderr


def test_a_path_that_the_encoding_of_the_output_lacks_is_printed_all_the_same(elsewhere):
    (elsewhere / "tiny.yaml").write_text(TINY)
    arguments = ("tiny.yaml", "--until", "prepare", "--out", "Süd", "--threads", "2", "--quiet")
    done = python("-m", "taichi_edges", *arguments, cwd=elsewhere, PYTHONIOENCODING="ascii")
    assert done.returncode == 0 and "results: S\\xfcd/tiny/" in done.stdout, done.stderr


# --------------------------------------------------------------------------------------------------------- the system


def test_memory_is_told_without_the_files_of_linux(monkeypatch, tmp_path):
    here = machine.peak_memory_mib()
    monkeypatch.setattr(machine, "PROCESS", tmp_path / "nowhere")
    machine.reset_peak_memory()
    assert 10 < machine.peak_memory_mib() <= 1.1 * here
