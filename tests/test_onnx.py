"""The detector that runs an ONNX file, on networks of a few weights that the tests write themselves."""

import itertools
import sys
import types

import cv2
import numpy as np
import pytest
from onnx_networks import FREE, grey_kernel, identity, node, write_convolution, write_network

from taichi_edges.detectors import onnx
from taichi_edges.detectors.onnx import PRESETS, Preset, detect_maps, preset_for, read_signature
from taichi_edges.detectors.ridges import ridge_points
from taichi_edges.errors import UserError
from taichi_edges.progress import Progress

PLAIN = Preset((0.0, 0.0, 0.0), (255.0, 255.0, 255.0), rgb=True, sigmoid=False)  # values 0..1 in, values 0..1 out
ROUNDED = 0.5 / 255 + 1e-5  # a map of uint8 against the exact value


# --- What a network sees and gives ---


def random_image(generator, height, width):
    return generator.integers(0, 256, (height, width, 3), dtype=np.uint8)


def drawn_line(height, width, angle, offset, sigma=1.2):
    """A bright line through the middle, `offset` px off it. Returns (H, W, 3) uint8 and its normal (2,)."""
    normal = np.array([np.cos(angle), np.sin(angle)])
    v, u = np.mgrid[:height, :width]
    across = (u - (width - 1) / 2) * normal[0] + (v - (height - 1) / 2) * normal[1] - offset
    profile = np.rint(255 * np.exp(-0.5 * (across / sigma) ** 2)).astype(np.uint8)
    return np.repeat(profile[:, :, None], 3, axis=2), normal


def line_offset(edge_map, normal):
    """How far from the middle the line of a map lies, px along the normal; without the ends, where padding shows."""
    points, _, _ = ridge_points(edge_map, 1.5, 0.2)
    from_centre = points - (np.array(edge_map.shape[::-1]) - 1) / 2
    inner = np.abs(from_centre).max(axis=1) < min(edge_map.shape) / 2 - 10
    assert inner.sum() > 10
    return float(np.median(from_centre[inner] @ normal))


def test_a_sobel_network_gives_the_sobel_map(tmp_path, generator):
    kernel = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]]) / 8
    path = write_convolution(tmp_path / "sobel.onnx", grey_kernel(kernel), shape=FREE)
    image = (random_image(generator, 37, 53) * np.linspace(0, 1, 53)[:, None]).astype(np.uint8)
    expected = cv2.filter2D(image.mean(axis=2) / 255.0, -1, kernel)[1:-1, 1:-1]
    shifted = Preset((-255.0,) * 3, (255.0,) * 3, sigmoid=True, multiple=16)
    found = detect_maps([image], path, shifted)[0]
    assert found.shape == (37, 53) and found.dtype == np.uint8
    np.testing.assert_allclose(found[1:-1, 1:-1] / 255.0, 1 / (1 + np.exp(-expected)), atol=ROUNDED)


def test_every_image_gets_its_map_in_order_whatever_its_size(tmp_path, generator):
    path = identity(tmp_path / "identity.onnx")
    images = [random_image(generator, *size) for size in ((40, 64), (33, 70), (64, 40))]
    seen = []

    class Recorder(Progress):
        def _update(self, task, done, note):
            seen.append((done, task.total))

    maps = detect_maps(images, path, PLAIN, threads=1, report=Recorder())
    for image, found in zip(images, maps, strict=True):
        np.testing.assert_allclose(found, image.mean(axis=2), atol=0.51)
    assert seen == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_float_images_are_taken_from_0_to_1(tmp_path, generator):
    image = random_image(generator, 32, 48)
    path = identity(tmp_path / "identity.onnx")
    from_bytes, from_floats = detect_maps([image, image / 255.0], path, PLAIN)
    np.testing.assert_array_equal(from_bytes, from_floats)


@pytest.mark.parametrize("rgb", [True, False])
def test_channel_order_mean_and_deviation_are_the_presets(tmp_path, generator, rgb):
    mixing, mean, deviation = np.array([0.02, 0.2, 0.5]), np.array([100.0, 120, 140]), np.array([50.0, 60, 70])
    path = write_convolution(tmp_path / "mix.onnx", mixing[:, None, None])
    image = random_image(generator, 32, 32)
    ordered = image if rgb else image[:, :, ::-1]
    logits = ((ordered - mean) / deviation) @ mixing
    found = detect_maps([image], path, Preset(tuple(mean), tuple(deviation), rgb=rgb, sigmoid=True))[0]
    np.testing.assert_allclose(found / 255.0, 1 / (1 + np.exp(-logits)), atol=ROUNDED)


def test_a_sigmoid_in_the_file_is_not_applied_again(tmp_path, generator):
    take_red = np.array([4.0, 0, 0], np.float32)[None, :, None, None]
    nodes = [node("Conv", ["image", "kernel"], "logits", kernel_shape=[1, 1]), node("Sigmoid", ["logits"], "map")]
    path = write_network(tmp_path / "red.onnx", nodes, {"kernel": take_red})
    assert read_signature(path).makers == ("Sigmoid",)
    image = random_image(generator, 32, 32)
    found = detect_maps([image], path, Preset((127.5,) * 3, (255.0,) * 3, rgb=True, sigmoid=True))[0]
    expected = 1 / (1 + np.exp(-4 * (image[:, :, 0] / 255.0 - 0.5)))
    np.testing.assert_allclose(found / 255.0, expected, atol=ROUNDED)


def test_full_scale_is_the_presets(tmp_path, generator):
    path = write_convolution(tmp_path / "bright.onnx", grey_kernel([[255.0]]))
    image = random_image(generator, 32, 32)
    found = detect_maps([image], path, Preset(PLAIN.mean, PLAIN.deviation, sigmoid=False, full=255.0))[0]
    np.testing.assert_allclose(found, image.mean(axis=2), atol=0.51)


def test_the_output_is_counted_as_the_file_declares_them(tmp_path, generator):
    nodes = [
        node("Conv", ["image", "kernel"], "middle", kernel_shape=[1, 1]),
        node("Mul", ["middle", "half"], "late"),
        node("Mul", ["late", "half"], "first"),
    ]
    constants = {"kernel": grey_kernel([[1.0]])[None], "half": 0.5}
    path = write_network(tmp_path / "three.onnx", nodes, constants, outputs=("first", "late", "middle"))
    image = random_image(generator, 32, 32)
    for output, factor in ((0, 0.25), (1, 0.5), (2, 1.0), (-1, 1.0), (-3, 0.25)):
        preset = Preset(PLAIN.mean, PLAIN.deviation, sigmoid=False, output=output)
        np.testing.assert_allclose(detect_maps([image], path, preset)[0], factor * image.mean(axis=2), atol=0.51)


# --- Padding, tiles, fixed sizes ---


def test_padding_repeats_the_border_and_is_cut_off_exactly(tmp_path, generator):
    path = write_convolution(tmp_path / "right.onnx", grey_kernel([[0, 0, 0], [0, 0, 1], [0, 0, 0]]))
    image = random_image(generator, 33, 49)  # 16 is the multiple
    found = detect_maps([image], path, PLAIN)[0]
    right = np.pad(image.mean(axis=2), ((0, 0), (0, 1)), mode="edge")[:, 1:]
    np.testing.assert_allclose(found, right, atol=0.51)


def test_a_network_that_halves_the_size_sees_whole_multiples(tmp_path, generator):
    nodes = [
        node("Conv", ["image", "kernel"], "grey", kernel_shape=[1, 1]),
        node("MaxPool", ["grey"], "half", kernel_shape=[2, 2], strides=[2, 2]),
        node("ConvTranspose", ["half", "spread"], "map", kernel_shape=[2, 2], strides=[2, 2]),
    ]
    constants = {"kernel": grey_kernel([[1.0]])[None], "spread": np.ones((1, 1, 2, 2))}
    path = write_network(tmp_path / "halves.onnx", nodes, constants)
    image = random_image(generator, 35, 41)
    padded = np.pad(image.mean(axis=2), ((0, 1), (0, 1)), mode="edge")
    largest = padded.reshape(18, 2, 21, 2).max(axis=(1, 3)).repeat(2, axis=0).repeat(2, axis=1)[:35, :41]
    np.testing.assert_allclose(detect_maps([image], path, PLAIN)[0], largest, atol=0.51)


@pytest.mark.parametrize("size", [(128, 128), (100, 90), (200, 150), (129, 400)])
def test_a_network_of_fixed_size_sees_larger_images_in_tiles(tmp_path, generator, size):
    path = identity(tmp_path / "fixed.onnx", shape=(1, 3, 128, 128))
    image = random_image(generator, *size)
    np.testing.assert_allclose(detect_maps([image], path, PLAIN)[0], image.mean(axis=2), atol=0.51)


def test_large_images_are_cut_without_a_seam(tmp_path, generator, monkeypatch):
    path = write_convolution(tmp_path / "mean.onnx", grey_kernel(np.full((5, 5), 1 / 25)))
    image = random_image(generator, 300, 500)
    whole = detect_maps([image], path, PLAIN)[0]
    monkeypatch.setattr(onnx, "MAX_TILE", 160)
    cut = detect_maps([image], path, PLAIN)[0]
    # The network's own zeros at the border of a tile reach 2 px, where a tile weighs less than 4 %.
    inner = np.s_[2:-2, 2:-2]
    assert np.abs(cut[inner].astype(int) - whole[inner]).max() <= np.ceil(0.04 * 255)
    assert np.abs(cut[inner].astype(float) - whole[inner]).mean() < 0.5


# --- Nothing moves an edge ---

DIRECTIONS = [0.0, 0.4, np.pi / 2, 2.0]


@pytest.mark.parametrize("scale", [2.0, 1.5, 0.5])
@pytest.mark.parametrize("angle", DIRECTIONS)
def test_resampling_leaves_a_line_where_it_is(tmp_path, generator, scale, angle):
    path = identity(tmp_path / "identity.onnx")
    image, normal = drawn_line(91, 101, angle, offset=generator.uniform(-0.4, 0.4), sigma=2.0)
    plain, scaled = (detect_maps([image], path, PLAIN, scale=s)[0] for s in (1.0, scale))
    assert plain.shape == scaled.shape
    assert abs(line_offset(scaled, normal) - line_offset(plain, normal)) < 0.05


def shifting(path, axis):
    """A network that moves everything by half a pixel along an axis of the image."""
    kernel = np.zeros((3, 3))
    kernel[1, 1] = 0.5
    kernel[(1, 2) if axis == 1 else (2, 1)] = 0.5
    return write_convolution(path, grey_kernel(kernel))


def test_mirroring_removes_a_horizontal_shift(tmp_path):
    path = shifting(tmp_path / "shifts.onnx", axis=1)
    image, normal = drawn_line(64, 71, 0.0, offset=0.3)
    found = {flip: line_offset(detect_maps([image], path, PLAIN, flip=flip)[0], normal) for flip in onnx.FLIPS}
    assert abs(found[False] - (0.3 - 0.5)) < 0.03
    assert abs(found[True] - 0.3) < 0.03 and abs(found["both"] - 0.3) < 0.03


def test_mirroring_both_ways_removes_a_vertical_shift(tmp_path):
    path = shifting(tmp_path / "shifts.onnx", axis=0)
    image, normal = drawn_line(64, 71, np.pi / 2, offset=0.3)
    found = {flip: line_offset(detect_maps([image], path, PLAIN, flip=flip)[0], normal) for flip in onnx.FLIPS}
    assert abs(found[True] - (0.3 - 0.5)) < 0.03
    assert abs(found["both"] - 0.3) < 0.03


def test_twice_the_size_halves_a_shift(tmp_path):
    path = shifting(tmp_path / "shifts.onnx", axis=1)
    image, normal = drawn_line(64, 71, 0.0, offset=0.0)
    assert abs(line_offset(detect_maps([image], path, PLAIN, scale=2)[0], normal) + 0.25) < 0.03


def test_a_mirrored_image_gives_the_mirrored_map(tmp_path, generator):
    path = write_convolution(tmp_path / "any.onnx", grey_kernel(generator.dirichlet(np.ones(9)).reshape(3, 3)))
    image = random_image(generator, 48, 64)  # of the multiple: the padding of others is on the right alone
    found, mirrored = detect_maps([image, image[:, ::-1]], path, PLAIN, flip=True)
    np.testing.assert_array_equal(mirrored, found[:, ::-1])


# --- Which network it is ---


@pytest.mark.parametrize(
    "name, key",
    [
        ("edge_detection_dexined_2024sep.onnx", "dexined"),
        ("table5_PiDiNet-tiny.onnx", "pidinet"),
        ("TEED.onnx", "teed"),
        ("model-hed.onnx", "hed"),
    ],
)
def test_the_files_name_says_which_network_it_is(name, key):
    assert preset_for(name) is PRESETS[key]
    assert preset_for("anything.onnx", key.upper()) is PRESETS[key]


@pytest.mark.parametrize("name, what", [("published.onnx", "does not say"), ("hed_or_bdcn.onnx", "holds bdcn and hed")])
def test_a_name_that_does_not_say_is_refused_with_the_known_ones(name, what):
    with pytest.raises(UserError, match=f"{name}: .*{what}.*dexined, ldc, teed, pidinet, bdcn, hed"):
        preset_for(name)


def test_an_unknown_network_is_refused():
    with pytest.raises(UserError, match="'pidinett' is not a known network; did you mean 'pidinet'"):
        preset_for("x.onnx", "pidinett")


def test_every_preset_can_be_cut_into_tiles():
    assert all(onnx.MAX_TILE % preset.multiple == 0 for preset in PRESETS.values())


# --- Errors ---

IMAGE = np.zeros((32, 32, 3), np.uint8)


def refusal(path, preset=PLAIN, image=IMAGE):
    with pytest.raises(UserError) as caught:
        detect_maps([image], path, preset)
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text and len(text) < 500
    return text


@pytest.fixture
def no_onnxruntime(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)  # importing it fails


def test_a_missing_file_is_named_with_its_neighbour(tmp_path):
    identity(tmp_path / "dexined.onnx")
    assert "not found; did you mean 'dexined.onnx'" in refusal(tmp_path / "dexinet.onnx")
    assert "not found; name the ONNX file" in refusal(tmp_path / "nowhere" / "x.onnx")
    assert "Is a directory" in refusal(tmp_path)


@pytest.mark.parametrize(
    "content, what",
    [
        (b"", "not an ONNX file"),
        (b"just some text, long enough to be anything", "not an ONNX file"),
        (b"PK\x03\x04rest", "PyTorch checkpoint"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:1", "git lfs pull"),
        (b"<!doctype html>", "web page"),
        (b"\x08\x07\x3a\x00", "declares no output"),
    ],
)
def test_what_is_no_onnx_file_is_refused(tmp_path, content, what):
    (tmp_path / "model.onnx").write_bytes(content)
    assert what in refusal(tmp_path / "model.onnx")


def test_a_damaged_file_is_refused(tmp_path, generator, no_onnxruntime):
    """Cut or changed anywhere: an error of one line or, where the change does not matter, a map."""
    whole = identity(tmp_path / "model.onnx").read_bytes()
    refused = 0
    for place in generator.integers(0, len(whole), 100):
        changed = bytearray(whole)
        changed[place] ^= int(generator.integers(1, 256))
        for content in (whole[:place], bytes(changed)):
            (tmp_path / "model.onnx").write_bytes(content)
            try:
                read_signature(tmp_path / "model.onnx")
            except UserError as error:
                refused += str(error).startswith(f"{tmp_path / 'model.onnx'}: ")
    assert refused >= 100  # what is cut is no ONNX file any more


def test_an_unknown_operator_is_named_with_the_remedy(tmp_path, no_onnxruntime):
    path = write_network(tmp_path / "fancy.onnx", [node("FancyEdges", ["image"], "map")])
    text = refusal(path)
    assert "operator FancyEdges is not supported" in text and "pip install onnxruntime" in text


def test_reasons_of_opencv_are_condensed():
    """As OpenCV 5 and 4 word them."""
    start = "OpenCV(4.12.0) /io/x.cpp:1: error: "
    node = "(-2:Unspecified error) in function 'handleNode'\n> Node [Shape@ai.onnx]:(n) parse error: "
    layer = '(-2:Unspecified error) Can\'t create layer "n" of type "Fancy" in function \'getLayerInstance\''
    check = "(-215:Assertion failed) inputs.size() > 0 in function 'getMemoryShapes'"
    assert onnx.condensed(f"{start}{node}{start}{layer}\n>") == "its operator Fancy is not supported"
    assert onnx.condensed(f"{start}{node}{start}{check}\n>") == "its operator Shape fails"
    assert onnx.condensed(f"{start}{check}") == "inputs.size() > 0"


def test_an_output_that_is_not_there_is_refused(tmp_path):
    text = refusal(identity(tmp_path / "one.onnx"), Preset(PLAIN.mean, output=6))
    assert "there is no output 6; it has 1, from 0 to 0 (map)" in text


def test_an_output_of_another_size_is_refused(tmp_path):
    nodes = [
        node("Conv", ["image", "kernel"], "grey", kernel_shape=[1, 1]),
        node("MaxPool", ["grey"], "map", kernel_shape=[2, 2], strides=[2, 2]),
    ]
    path = write_network(tmp_path / "small.onnx", nodes, {"kernel": grey_kernel([[1.0]])[None]})
    assert "'map' is 1 x 1 x 16 x 16, not one map in the size of the image, 1 x 1 x 32 x 32" in refusal(path)


def test_an_output_of_several_channels_is_refused(tmp_path):
    path = write_network(tmp_path / "rgb.onnx", [node("Relu", ["image"], "map")])
    assert "'map' is 1 x 3 x 32 x 32" in refusal(path)


def test_an_output_that_is_not_finite_is_refused(tmp_path):
    nodes = [node("Conv", ["image", "kernel"], "grey", kernel_shape=[1, 1]), node("Div", ["grey", "grey"], "map")]
    divides = write_network(tmp_path / "divides.onnx", nodes, {"kernel": grey_kernel([[1.0]])[None]})
    for path in (divides, write_convolution(tmp_path / "nan.onnx", np.full((3, 1, 1), np.nan))):
        assert "output 'map' is not finite" in refusal(path)


def test_logits_where_a_sigmoid_is_expected_are_refused(tmp_path):
    path = write_convolution(tmp_path / "logits.onnx", grey_kernel([[7.0]]))
    assert "ranges from 7 to 7, not from 0 to 1" in refusal(path, image=IMAGE + 255)


@pytest.mark.parametrize(
    "shape, what",
    [
        (("batch", 1, "height", "width"), r"its input is \? x 1 x \? x \?"),
        ((1, 256, 256, 3), "its input is 1 x 256 x 256 x 3"),
        ((8, 3, "height", "width"), "its input is 8 x 3"),
        ((1, 3, 64, 64), "128 px are the least"),
    ],
)
def test_inputs_that_are_no_image_are_refused(tmp_path, shape, what):
    with pytest.raises(UserError, match=what):
        detect_maps([IMAGE], identity(tmp_path / "shape.onnx", shape=shape), PLAIN)


def test_numbers_of_other_kinds_are_refused(tmp_path):
    assert "export the model in float32" in refusal(identity(tmp_path / "half.onnx", kind=10))


# --- onnxruntime, where OpenCV cannot ---


def stub_of_onnxruntime(monkeypatch, run):
    """A module with the part of onnxruntime's interface that is used; `run` maps (1, 3, h, w) to the answer."""
    sessions = []

    class InferenceSession:
        def __init__(self, path, options, providers):
            self.options, self.asked = options, []
            sessions.append(self)

        def run(self, names, feeds):
            self.asked.append((names, list(feeds)))
            return [run(feeds["image"])]

    stub = types.SimpleNamespace(InferenceSession=InferenceSession, SessionOptions=types.SimpleNamespace)
    monkeypatch.setitem(sys.modules, "onnxruntime", stub)
    return sessions


class Listener(Progress):
    def __init__(self):
        self.said = []

    def say(self, text):
        self.said.append(text)


def test_onnxruntime_runs_what_opencv_refuses(tmp_path, generator, monkeypatch):
    sessions = stub_of_onnxruntime(monkeypatch, lambda blob: blob.mean(axis=1, keepdims=True))
    path, report = write_network(tmp_path / "fancy.onnx", [node("FancyEdges", ["image"], "map")]), Listener()
    images = [random_image(generator, 32, 48) for _ in range(2)]
    maps = detect_maps(images, path, PLAIN, threads=3, report=report)
    for image, found in zip(images, maps, strict=True):
        np.testing.assert_allclose(found, image.mean(axis=2), atol=0.51)
    (session,) = sessions
    assert session.asked == [(["map"], ["image"])] * 2 and session.options.intra_op_num_threads == 3
    assert report.said == [
        "fancy.onnx: OpenCV cannot run it (its operator FancyEdges is not supported); onnxruntime does"
    ]


def test_onnxruntime_runs_what_fails_in_opencv_later(tmp_path, generator, monkeypatch):
    sessions = stub_of_onnxruntime(monkeypatch, lambda blob: blob[:, :1])
    net = types.SimpleNamespace(setInput=lambda blob: None, forward=lambda name: raises())

    def raises():
        raise cv2.error("OpenCV(5.0) x.cpp:1: error: (-215:Assertion failed) a == b in function 'forward'")

    monkeypatch.setattr(cv2.dnn, "readNetFromONNX", lambda path: net)
    path, report = identity(tmp_path / "late.onnx"), Listener()
    image = random_image(generator, 32, 32)
    np.testing.assert_array_equal(detect_maps([image], path, PLAIN, report=report)[0], image[:, :, 0])
    assert len(sessions) == 1 and "(a == b)" in report.said[0]


def test_both_reasons_are_given_where_neither_can(tmp_path, monkeypatch):
    def fails(blob):
        raise RuntimeError("[ONNXRuntimeError] : 9 : no kernel\nfor FancyEdges")

    stub_of_onnxruntime(monkeypatch, fails)
    text = refusal(write_network(tmp_path / "fancy.onnx", [node("FancyEdges", ["image"], "map")]))
    assert "OpenCV: its operator FancyEdges is not supported; onnxruntime: [ONNXRuntimeError] : 9 : no kernel" in text


def test_onnxruntime_and_opencv_agree(tmp_path, generator, monkeypatch):
    pytest.importorskip("onnxruntime")
    path = write_convolution(tmp_path / "any.onnx", grey_kernel(generator.dirichlet(np.ones(9)).reshape(3, 3)))
    images = [random_image(generator, 50, 70) for _ in range(2)]
    by_opencv = detect_maps(images, path, PLAIN, scale=2, flip=True)

    def refuses(path):
        raise cv2.error("refused")

    monkeypatch.setattr(cv2.dnn, "readNetFromONNX", refuses)
    by_runtime = detect_maps(images, path, PLAIN, scale=2, flip=True)
    for one, other in itertools.zip_longest(by_opencv, by_runtime):
        assert np.abs(one.astype(int) - other).max() <= 1


def test_opencv_keeps_its_number_of_threads(tmp_path):
    before = cv2.getNumThreads()
    detect_maps([IMAGE], identity(tmp_path / "identity.onnx"), PLAIN, threads=1)
    assert cv2.getNumThreads() == before
