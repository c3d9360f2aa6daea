"""Scene files: what is read, what overrides what, and how mistakes are named."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from taichi_edges.corridor.loading import load_scene
from taichi_edges.errors import UserError
from taichi_edges.scene.paths import SHIPPED
from taichi_edges.scene.presets import PRESETS, SCALES, SCALES_OF_READERS
from taichi_edges.scene.scene_file import check_scene
from taichi_edges.scene.settings import SceneConfig

SCENES = sorted((Path(__file__).parent.parent / "scenes").glob("*.yaml"))
SYNTHETIC = "source: {reader: synthetic, part: block}\n"


@pytest.fixture
def scene(tmp_path):
    """scene(text) -> path of a scene file that adds `text` to a valid scene."""

    def write(text="", base=SYNTHETIC, name="scene.yaml"):
        path = tmp_path / name
        path.write_bytes((base + text).encode())
        return path

    return write


def refusal(path, *arguments, **options):
    """The message with which a scene is refused, which must be one line."""
    with pytest.raises(UserError) as refused:
        load_scene(path, *arguments, **options)
    text = str(refused.value)
    assert "\n" not in text and text
    return text


# -------------------------------------------------------------------------------------------------- what comes along


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_scenes_that_come_along_load_and_name_their_folder(path):
    assert load_scene(path).name == path.stem


def test_some_scenes_come_along():
    assert {"demo", "abc_00000006", "abc_00004926"} <= {path.stem for path in SCENES}


def test_the_paper_preset_has_the_numbers_of_the_supplement():
    train = PRESETS["paper"]["train"]
    assert train["gaussians"] == 10_000  # "10000 points randomly sampled in a unit cube"
    assert (train["initial_scale"], train["initial_opacity"]) == (0.004, 0.08)
    assert train["epochs"] == 500
    assert train["only_means"] * 500 == 30  # "For the first 30 epochs, we only train the position parameters"
    assert train["learning_rates"] == {"means": 1e-3, "scales": 2e-4, "opacities": 3e-2, "quaternions": 1e-3}
    # "scaled with a factor of 0.75 every 10 epochs, 5 times"
    assert (train["means_decay"], train["means_decay_every"] * 500, train["means_decays"]) == (0.75, 10, 5)
    assert train["neighbors"] == 4  # k of eq. 4
    assert (train["orient_weight"], train["shape_weight"]) == (0.1, 0.1)  # object level scenes
    assert (train["regularize_from"] * 500, train["regularize_every"]) == (300, 10)
    # eq. 3: all edge pixels, and as many of the background, all weighing alike
    assert train["loss"] == "balanced"
    assert (train["strength_weight"], train["flanks_from"]) == (0.0, 1.0)


def test_the_defaults_are_what_a_scene_without_settings_gets(scene):
    assert load_scene(scene()) == SceneConfig(source={"reader": "synthetic", "part": "block"}, name="scene")
    assert SceneConfig.model_fields["preset"].default == "fast" and SceneConfig.model_fields["scale"].default == "part"


def test_a_preset_on_the_command_line_replaces_every_value_of_the_other(scene):
    def keys(values):
        return {key: keys(below) if isinstance(below, dict) else None for key, below in values.items()}

    assert keys(PRESETS["fast"]) == keys(PRESETS["paper"])
    resolved = scene(yaml.safe_dump(load_scene(scene(), preset="paper").model_dump()), base="", name="resolved.yaml")
    assert load_scene(resolved, preset="fast") == load_scene(scene())


def test_clustering_and_fitting_start_from_the_supplement(scene):
    config = load_scene(scene())
    assert config.cluster.theta == 0.8 and config.fit.delta == 0.5


def test_every_value_has_a_meaning():
    def check(section, prefix):
        for key, field in section.model_fields.items():
            if hasattr(field.annotation, "model_fields"):
                check(field.annotation, f"{prefix}{key}.")
            else:
                assert field.description or key in ("initial_opacity", "min_opacity"), f"{prefix}{key}"

    check(SceneConfig, "")


def test_a_resolved_scene_loads_to_itself(scene, tmp_path):
    config = load_scene(scene("train: {epochs: 7}\nfit: {delta: 1e-3}\n"))
    copy = tmp_path / "copy.yaml"
    copy.write_text(yaml.safe_dump(config.model_dump(), sort_keys=False))
    assert load_scene(copy) == config


# ------------------------------------------------------------------------------------------------------ unknown keys


@pytest.mark.parametrize(
    ("text", "key", "nearest"),
    [
        ("trian: {epochs: 3}", "trian", "'train'"),
        ("train: {epoch: 3}", "train.epoch", "'epochs'"),
        ("train: {learning_rates: {mean: 1}}", "train.learning_rates.mean", "'means'"),
        ("train: {density: {min_opacty: 0.1}}", "train.density.min_opacty", "'min_opacity'"),
        ("epochs: 3", "epochs", "'train.epochs'"),
        ("cluster: {delta: 1}", "cluster.delta", "'fit.delta'"),
        ("fit: {thetta: 1}", "fit.thetta", "'theta'"),
        ("train: {max_gaussians: 9}", "train.max_gaussians", "'train.density.max_gaussians'"),
    ],
)
def test_an_unknown_key_is_named_with_the_nearest_valid_one(scene, text, key, nearest):
    path = scene(text)
    message = refusal(path)
    assert message.startswith(f"{path}: {key}: unknown key; did you mean '")
    assert nearest.strip("'") in message


def test_an_unknown_key_like_no_other_lists_the_known_ones(scene):
    assert "known here: delta, line_tolerance, min_length" in refusal(scene("fit: {zzzzqq: 3}"))


@pytest.mark.parametrize("key", ["grow_step: 0.5", "grow: 0.1", "harvest: true", "min_angle: 15.0"])
def test_a_key_that_is_gone_says_what_to_do(scene, key):
    path = scene(f"filter: {{{key}}}")
    said, gone = refusal(path), f"{path}: filter.{key.split(':')[0]}: unknown key; it is gone, for "
    assert said.startswith(gone) and said.endswith("; leave it out")


def test_all_mistakes_are_counted(scene):
    assert "and 2 more mistakes" in refusal(scene("fit: {delta: -1, foo: 2}\nseed: x\n"))


def test_a_key_with_a_line_break_is_refused_in_one_line(scene):
    assert "unknown key" in refusal(scene('"a\\nb": 3'))


# ------------------------------------------------------------------------------------------------ types and units


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ("1e-3", 0.001),
        ("1E-3", 0.001),
        ("1.e3", 1000.0),
        ("1", 1.0),
        (".5", 0.5),
        ("+2.5e+1", 25.0),
        ("1_000.5", 1000.5),
    ],
)
def test_numbers_are_read_as_numbers(scene, written, read):
    value = load_scene(scene(f"fit: {{delta: {written}}}")).fit.delta
    assert value == read and isinstance(value, float)


@pytest.mark.parametrize(("written", "read"), [("10_000", 10_000), ("7", 7), ("0x10", 16)])
def test_whole_numbers_are_read(scene, written, read):
    assert load_scene(scene(f"train: {{epochs: {written}}}")).train.epochs == read


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("fit: {min_length: 10 mm}", "fit.min_length: must be a number, not '10 mm' (shorter edges"),
        ("fit: {min_length: '1e-3'}", "fit.min_length: must be a number, not '1e-3'"),
        ("fit: {delta: .nan}", "fit.delta: must be a finite number, not nan"),
        ("fit: {delta: 1e999}", "fit.delta: must be a finite number, not inf"),
        (
            "train: {epochs: true}",
            "train.epochs: must be a whole number, not true (passes over all views; 0: train.steps counts)",
        ),
        ("train: {epochs: 1.5}", "train.epochs: must be a whole number, not 1.5"),
        ('train: {epochs: "5"}', "train.epochs: must be a whole number, not '5'"),
        ("train: {epochs: 010}", "train.epochs: must be a whole number"),
        ("train: {epochs: 1:30}", "train.epochs: must be a whole number, not '1:30'"),
        ("train: {epochs: -1}", "train.epochs: must be at least 0, not -1"),
        ("train: {epochs: 0, steps: 0}", "train: the length is given in epochs or in steps; set one of them"),
        ("train: {epochs: 9, steps: 9}", "train: the length is given in epochs or in steps; set one of them"),
        ("train: {epochs:}", "train.epochs: must be a whole number, not null"),
        ("cluster: {theta: 80}", "cluster.theta: must be at most 1, not 80"),
        ("train: {initial_scale: 0}", "train.initial_scale: must be greater than 0, not 0"),
        ("train: {density: {reset_opacity: 1}}", "train.density.reset_opacity: must be true or false, not 1"),
        ("train: {density: {duplicate_at: [2]}}", "train.density.duplicate_at.0: must be at most 1, not 2"),
        ("train: {loss: balance}", "train.loss: must be 'balanced', 'class_weighted' or 'whole_image', not 'balance'"),
        ("train:", "train: must be a section with keys of its own, not null"),
        ("train: [1]", "train: must be a section with keys of its own"),
        ("name: 123", "name: must be a text, in quotes, not 123"),
        ("name: a/b", "name: may hold only letters, digits"),
        ("name: ..", "name: may hold only letters, digits"),
        ("seed: -1", "seed: must be at least 0, not -1"),
        ("seed: 99999999999999", "seed: must be less than"),
        ("box: 3", "box: must be a list"),
        ("box: [[0, 0, 0], [1, 1]]", "box.1: must have 3 entries, not 2"),
        ("box: [[0, 0, 0], [1, 1, 0]]", "box: the second corner must be greater than the first"),
        ("preset: papre", "preset: must be 'fast' or 'paper', not 'papre'"),
        ("preset: [paper]", "preset: must be 'fast' or 'paper'"),
        ("3: 4", "3: a key must be a text"),
    ],
)
def test_a_wrong_value_is_named_with_file_key_and_what_is_expected(scene, text, says):
    path = scene(text)
    assert refusal(path).startswith(f"{path}: {says}")


def test_a_reader_without_a_folder_is_refused(scene):
    assert "source.path is missing" in refusal(scene(base="source: {reader: nerf}\n"))


def test_a_file_name_that_cannot_name_a_folder_is_refused(scene):
    message = refusal(scene(name="my scene.yaml"))
    assert "name: may hold only" in message and "the file's name unless set" in message
    assert load_scene(scene("name: mine", name="my scene.yaml")).name == "mine"


# ------------------------------------------------------------------------------------------------------ broken files


@pytest.mark.parametrize(
    ("text", "place", "says"),
    [
        ("fit: {delta: 1\n", "line 3, column 1", "not valid YAML"),
        ("fit:\n\tdelta: 1\n", "line 3, column 1", "not valid YAML"),
        ("fit: {delta: 1, delta: 2}\n", "line 2, column 17", "the key 'delta' is given twice"),
        ("source: {}\n", "line 2, column 1", "the key 'source' is given twice"),
        ("fit: *nowhere\n", "line 2, column 6", "not valid YAML"),
        ("fit: !!python/name:os.system {}\n", "line 2, column 6", "not valid YAML"),
        ("---\nseed: 1\n", "line 2, column 1", "not valid YAML"),
        ("fit: " + 3000 * "[", "not valid YAML", "nested too deeply"),
    ],
)
def test_broken_yaml_is_named_with_line_and_column(scene, text, place, says):
    path = scene(text)
    message = refusal(path)
    assert message.startswith(f"{path}: {place}: ") and says in message


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "it is empty"),
        (b"# nothing but a comment\n", "it is empty"),
        (b"- a\n", "this is a list"),
        (b"hello\n", "this is 'hello'"),
        (bytes(range(256)), "not a text file"),
        (b"name: \x00\x01", "control characters"),
    ],
)
def test_a_file_that_is_no_scene_is_named(tmp_path, content, says):
    path = tmp_path / "scene.yaml"
    path.write_bytes(content)
    message = refusal(path)
    assert message.startswith(f"{path}: ") and says in message
    if "not valid YAML" not in message:
        assert str(SHIPPED / "demo.yaml") in message  # an example that whoever installed the package has, too


def test_a_folder_is_a_scene_without_keys(tmp_path):
    folder = tmp_path / "my photos"
    folder.mkdir()
    config = load_scene(folder, settings=["fit.delta=0.3"], seed=3, scale="room")
    assert (config.name, config.source.reader, config.source.path) == ("my-photos", "auto", str(folder))
    assert (config.fit.delta, config.seed, config.scale) == (0.3, 3, "room")


def test_a_missing_scene_is_named_with_its_nearest_neighbour(tmp_path, scene):
    message = refusal(tmp_path / "bolt.yaml")
    assert "No such file or directory; scenes that come along: abc_00000006, " in message and ", demo, " in message
    scene(name="nut.yaml")
    assert "did you mean 'nut.yaml'?" in refusal(tmp_path / "nutt.yaml")


def test_a_byte_order_mark_and_windows_line_ends_do_no_harm(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_bytes(("\ufeff" + SYNTHETIC + "seed: 3\n").replace("\n", "\r\n").encode())
    assert load_scene(path).seed == 3


# ------------------------------------------------------------------------------------------------------- precedence


def test_a_length_in_epochs_replaces_one_in_steps_and_the_other_way_round(scene):
    def length(text, **options):
        train = load_scene(scene(text), **options).train
        return train.epochs, train.steps

    assert length("preset: fast\ntrain: {epochs: 7}") == (7, 0)
    assert length("preset: paper\ntrain: {steps: 7}") == (0, 7)
    assert length("preset: fast\ntrain: {epochs: 7}", settings=["train.steps=8"]) == (0, 8)
    assert length("preset: paper\ntrain: {steps: 7}", settings=["train.epochs=8"]) == (8, 0)
    assert length("train: {steps: 7}", preset="paper") == (500, 0)


def test_the_scene_overrides_the_preset_key_by_key(scene):
    config = load_scene(scene("preset: paper\ntrain: {epochs: 7, learning_rates: {means: 0.5}}"))
    rates = config.train.learning_rates
    assert (config.train.epochs, rates.means, rates.scales) == (7, 0.5, 2e-4)


def test_a_preset_on_the_command_line_overrides_the_scene_where_it_names_a_key(scene):
    path = scene("train: {epochs: 7, edge_threshold: 0.3}\nfit: {delta: 0.9}")
    config = load_scene(path, preset="paper")
    assert config.train.epochs == 500
    assert config.train.edge_threshold == 0.3 and config.fit.delta == 0.9


def test_set_overrides_scene_and_preset(scene):
    path = scene("train: {epochs: 7}")
    assert load_scene(path, settings=["train.epochs=8"]).train.epochs == 8
    assert load_scene(path, preset="paper", settings=["train.epochs=8"]).train.epochs == 8
    assert load_scene(path, settings=["train.epochs=8", "train.epochs=9"]).train.epochs == 9


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("train.learning_rates.means=1e-2", lambda c: c.train.learning_rates.means == 0.01),
        ("train.density.duplicate_at=[]", lambda c: c.train.density.duplicate_at == []),
        ("source.skip=[a, b]", lambda c: c.source.skip == ["a", "b"]),
        ("fit={delta: 0.2}", lambda c: c.fit.delta == 0.2 and c.fit.min_length == 0.01),
        (" seed = 4", lambda c: c.seed == 4),
        ("name=other", lambda c: c.name == "other"),
    ],
)
def test_set_reaches_any_key(scene, setting, value):
    assert value(load_scene(scene(), settings=[setting]))


def test_values_from_python_need_not_be_what_yaml_gives(scene):
    box, corners = [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]], ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    for given in (box, corners, np.array(box), np.array(box, np.float32), (np.zeros(3), np.array([1.0, 2.0, 3.0]))):
        assert load_scene(scene(), settings={"box": given}).box == box
    settings = {"train": {"epochs": np.int64(3)}, "fit.delta": np.float64(0.25), "source.thin": np.bool_(False)}
    config = load_scene(scene(), settings={**settings, "source.path": Path("some/where")}, seed=np.int32(5))
    assert (config.train.epochs, config.fit.delta, config.source.thin, config.seed) == (3, 0.25, False, 5)
    assert config.source.path == str(Path("some/where")) and yaml.safe_dump(config.model_dump())


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ("train.steps=3", "settings: must be a dict, or a list of 'key=value', not 'train.steps=3'"),
        (None, "settings: must be a dict, or a list of 'key=value', not None"),
        ([3], "settings: must be a dict, or a list of 'key=value', not [3]"),
        ({3: 4}, "3=4: a key is a text, names with one dot between them, e.g. 'train.epochs'"),
        ({"train..steps": 4}, "train..steps=4: a key is a text, names with one dot between them"),
        ({"": 4}, "=4: a key is a text"),
        ({"preset": {}}, "preset={}: a preset brings many values with it; give it as the argument preset"),
        (
            {"box": np.eye(3)},
            "box=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]: box: must have 2 entries, not 3",
        ),
    ],
)
def test_wrong_settings_from_python_are_named(scene, settings, says):
    assert refusal(scene(), settings=settings).startswith(says)


def test_a_preset_that_is_no_text_is_refused(scene):
    assert refusal(scene(), preset={}).startswith("preset {}: there is no such preset; there is paper, fast")


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("train.epochs", "write key=value"),
        ("=3", "write key=value"),
        ("train..epochs=3", "write key=value"),
        ("train.epoch=3", "train.epoch: unknown key; did you mean 'epochs'?"),
        ("train.epochs=abc", "train.epochs: must be a whole number, not 'abc'"),
        ("train.epochs=", "train.epochs: must be a whole number, not null"),
        ("train=3", "train: must be a section"),
        ("train.epochs.more=3", "train.epochs: must be a whole number"),
        ("preset=paper", "use --preset paper"),
    ],
)
def test_a_wrong_set_is_named_as_it_was_given(scene, setting, says):
    message = refusal(scene(), settings=[setting])
    assert message.startswith(f"--set {setting}: ") and says in message


def test_broken_yaml_in_set_is_named(scene):
    assert refusal(scene(), settings=["fit.delta=[1"]).startswith("--set fit.delta: line 1, column")


def test_a_mistake_in_the_file_is_not_blamed_on_set(scene):
    path = scene("fit: {delta: x}")
    assert refusal(path, settings=["train.epochs=3"]).startswith(f"{path}: fit.delta: ")


def test_the_seed_of_the_command_line_overrides_all(scene):
    assert load_scene(scene("seed: 3"), settings=["seed=4"], seed=5).seed == 5
    assert refusal(scene(), seed=-1).startswith("seed -1: ")


def test_an_unknown_preset_is_refused(scene):
    assert "there is paper" in refusal(scene(), preset="papre")


def test_a_scene_cannot_be_changed_after_loading(scene):
    with pytest.raises(Exception, match="frozen"):
        load_scene(scene()).train.epochs = 3


@pytest.mark.parametrize(
    ("written", "meant"),
    [("auto", "auto"), ("off", "off"), (False, "off"), (True, "auto"), (4, 4), (["a", "b"], ["a", "b"])],
)
def test_views_are_held_out_by_number_or_name(written, meant):
    scene = {"source": {"reader": "emap", "path": "x"}, "evaluation": {"held_out": written}}
    assert check_scene(scene, "the test").evaluation.held_out == meant
    for wrong in (0, -1, 2.5, "some", [], [3]):
        scene["evaluation"] = {"held_out": wrong}
        with pytest.raises(UserError, match="evaluation.held_out: must be auto, off or a number, or a list of names"):
            check_scene(scene, "the test")


# ------------------------------------------------------------------------------------------------------------ scales


def test_every_preset_knows_every_scale():
    scales = SceneConfig.model_fields["scale"].annotation.__args__
    assert set(SCALES) == set(scales)
    assert all(set(of_scale) == set(PRESETS) for of_scale in SCALES.values())


@pytest.mark.parametrize("scale", ["building", "room"])
def test_large_scenes_have_the_numbers_of_the_supplement(scene, scale):
    train = load_scene(scene(f"preset: paper\nscale: {scale}")).train
    assert (train.orient_weight, train.shape_weight, train.neighbors) == (0.01, 0.01, 4)
    assert train.seeds == "auto"  # SfM points, where there are any


def test_a_scale_lies_between_the_preset_and_the_scene(scene):
    config = load_scene(scene("preset: paper\nscale: room\ntrain: {orient_weight: 0.5}"))
    assert (config.train.orient_weight, config.train.shape_weight, config.train.epochs) == (0.5, 0.01, 500)


def test_a_preset_on_the_command_line_brings_what_it_says_for_the_scale(scene):
    path = scene("scale: building")
    assert load_scene(path).train.orient_weight == 0.1  # the preset fast says nothing of buildings
    assert load_scene(path, preset="paper").train.orient_weight == 0.01
    assert load_scene(path, preset="paper", settings=["train.orient_weight=0.3"]).train.orient_weight == 0.3


def test_a_scale_on_the_command_line_replaces_that_of_the_scene(scene):
    path = scene("preset: paper\nscale: building")
    config = load_scene(path, scale="object")
    assert (config.scale, config.train.orient_weight) == ("object", 0.1)
    config = load_scene(scene("train: {orient_weight: 0.5}"), preset="paper", scale="room")
    assert (config.scale, config.train.orient_weight) == ("room", 0.01)


@pytest.mark.parametrize("reader, expected", SCALES_OF_READERS.items())
def test_photographs_are_taken_for_what_their_reader_reads(scene, reader, expected):
    source = f"source: {{reader: {reader}, path: there}}\n"
    config = load_scene(scene(source, base=""))
    assert config.scale == expected and config.train.seeds == "pair" and config.source.min_chain > 0
    part = load_scene(scene(f"{source}scale: part", base=""))
    assert part.scale == "part" and part.train.seeds == "lift" and part.source.min_chain == 0
    assert load_scene(scene(source, base=""), scale="room").refine.anchor


@pytest.mark.parametrize("reader", ["emap", "nerf"])
def test_renderings_are_parts_whose_settings_are_those_of_the_preset(scene, reader):
    config = load_scene(scene(f"source: {{reader: {reader}, path: there}}", base=""))
    assert config.scale == "part" and SCALES["part"] == {"fast": {}, "paper": {}}
    assert (config.train.seeds, config.source.min_chain, config.source.tolerance_px) == ("lift", 0, 0.5)
    assert (config.filter.min_views, config.refine.min_views, config.refine.min_support) == (2.5, 2.5, 0.0)
    assert config.refine.verdict and not config.refine.anchor


def test_an_unknown_scale_is_refused(scene):
    assert "scale: must be 'part', 'object', 'building' or 'room', not 'city'" in refusal(scene("scale: city"))
    assert "scale: must be" in refusal(scene("scale: [room]"))
    assert refusal(scene(), scale="city").startswith("scale city: there is no such scale; there is part, object")
    assert "use --scale room" in refusal(scene(), settings=["scale=room"])


@pytest.fixture
def photographs(tmp_path):
    """A data root with photographs in `album`, and an IDR scene in `thing`."""
    for name in ("album/a.png", "album/b.png", "thing/image/0.png", "thing/cameras_sphere.npz"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    return tmp_path


@pytest.mark.parametrize("reader", ["", "reader: auto, "])
def test_a_scene_without_a_reader_has_the_scale_of_the_one_that_fits(scene, photographs, reader):
    path = scene(f"preset: paper\nsource: {{{reader}path: album}}\n", base="")
    config = load_scene(path, data_root=photographs)
    assert (config.scale, config.source.reader) == ("building", "auto")
    assert config.train.orient_weight == SCALES["building"]["paper"]["train"]["orient_weight"]
    assert load_scene(path, data_root=photographs, settings=["source.path=thing"]).scale == "object"
    assert load_scene(path, data_root=photographs, scale="room").scale == "room"
    assert load_scene(path).scale == load_scene(path, data_root=photographs / "album").scale == "part"  # not there
    absolute = scene(f"source: {{{reader}path: {photographs / 'thing'}}}\n", base="")
    assert load_scene(absolute).scale == "object"
    said = scene(f"scale: part\nsource: {{{reader}path: album}}\n", base="")
    assert load_scene(said, data_root=photographs).scale == "part"


def test_a_reader_on_the_command_line_brings_its_scale(scene, photographs):
    assert load_scene(photographs / "album").scale == "building"
    assert load_scene(photographs / "album", settings=["source.reader=emap"]).scale == "part"
    assert load_scene(photographs / "thing", settings=["source.reader=colmap"]).scale == "building"
    named = scene("source: {path: thing}", base="")
    assert load_scene(named, settings=["source.reader=nerfstudio"]).scale == "building"


def test_a_preset_on_the_command_line_leaves_nothing_of_the_other_one(scene):
    """What the default preset says for buildings alone must not stay where the paper's has no word on it."""
    path = scene("scale: building")
    assert load_scene(path).source.min_chain > 0 and load_scene(path).refine.anchor
    paper = load_scene(path, preset="paper")
    assert paper.source.min_chain == 0 and not paper.refine.anchor and paper.filter.min_support == 0.05
