"""Edge maps from a learned detector that the user has as an ONNX file: DexiNed, PiDiNet, TEED and their like.

OpenCV runs the network; onnxruntime, where it is installed, runs what OpenCV cannot. Nothing here moves an edge:
resampling keeps the pixel centres, padding is at the right and the bottom only, a mirrored image is mirrored back.
"""

import contextlib
import importlib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from taichi_edges.errors import UserError, did_you_mean
from taichi_edges.progress import Progress

CAFFE_BGR = (104.007, 116.669, 122.679)  # mean of ImageNet's pixels, as rounded in the repositories below
VGG_BGR = (103.939, 116.779, 123.68)
IMAGENET_RGB = (0.485 * 255, 0.456 * 255, 0.406 * 255)
IMAGENET_RGB_DEVIATION = (0.229 * 255, 0.224 * 255, 0.225 * 255)
MAX_TILE = 1600  # px; larger images are cut, or the first layers alone take several GB. A multiple of every `multiple`
TILE_OVERLAP = 64  # px that two neighbouring tiles share, over which one fades into the other
MIN_TILE = 2 * TILE_OVERLAP  # px; a smaller network sees nothing but margins
RANGE_TOLERANCE = 1e-3  # of full scale, by which rounding may take a map out of its range
HUGE = 1e30  # no value of a network; OpenCV's convolutions turn NaN into the largest float32
LONGEST_REASON = 200  # letters of another library's message that are quoted
FLOAT32 = 1  # TensorProto.DataType
SILENT = 0  # OpenCV's log level
MAX_SIDE = 1 << 20  # px; some exporters write 0 or -1, which is 2^64 - 1, for a side that is free
# Which axes of (1, 3, h, w) are mirrored, each time the network runs. Both ways costs four runs: a shift that is not
# horizontal needs it.
FLIPS = {False: ((),), True: ((), (-1,)), "both": ((), (-1,), (-2,), (-2, -1))}
# What is taken for a model by mistake, by its first bytes.
FOREIGN = {
    b"PK\x03\x04": "a PyTorch checkpoint or another zip archive; export it with torch.onnx.export",
    b"\x80\x02": "a pickled PyTorch checkpoint; export it with torch.onnx.export",
    b"version https://git-lfs": "only a pointer of Git LFS; download the file itself (git lfs pull)",
    b"<": "a web page, not the file behind it; download it again",
}


@dataclass(frozen=True)
class Preset:
    """How a network wants its input and what its output means.

    mean, deviation: of the three channels, in the network's order, for pixel values 0..255; the input is
    (pixels - mean) / deviation. rgb: channel order, else BGR. multiple: px, of which width and height must be.
    output: which of the outputs, as declared in the file; -1 is the last one. sigmoid: the output is in logits.
    full: the value of a certain edge, 0 being none, after the sigmoid.
    """

    mean: tuple[float, ...]
    deviation: tuple[float, ...] = (1.0, 1.0, 1.0)
    rgb: bool = False
    multiple: int = 16
    output: int = -1
    sigmoid: bool = True
    full: float = 1.0


# As the authors' own test code does it; the last output is the fused one in all of them.
PRESETS = {
    "dexined": Preset(VGG_BGR),  # github.com/xavysp/DexiNed: datasets.py, utils/image.py
    "ldc": Preset(VGG_BGR),  # github.com/xavysp/LDC: dataset.py, the weights trained on BIPED
    "teed": Preset(CAFFE_BGR, multiple=8),  # github.com/xavysp/TEED: dataset.py ("CLASSIC"), ted.py
    # github.com/hellozhuo/pidinet: edge_dataloader.py, models/pidinet.py, where three poolings halve the size
    "pidinet": Preset(IMAGENET_RGB, IMAGENET_RGB_DEVIATION, rgb=True, multiple=8, sigmoid=False),
    "bdcn": Preset(CAFFE_BGR, multiple=8),  # github.com/pkuCactus/BDCN: cfg.py, test.py
    # github.com/sniklaus/pytorch-hed: run.py; subtracts the mean itself, from values 0..1
    "hed": Preset((0.0, 0.0, 0.0), (255.0, 255.0, 255.0), sigmoid=False),
}


@dataclass(frozen=True)
class Signature:
    """What an ONNX file declares. size: (height, width) px, each None where it is free. outputs: their names.

    makers: for each output, the operator that makes it.
    """

    input: str
    size: tuple[int | None, int | None]
    outputs: tuple[str, ...]
    makers: tuple[str, ...]


class Images(Protocol):
    """What gives images one after the other, and says how many."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[np.ndarray]: ...


Described = tuple[int | None, tuple[int | None, ...]]  # of an input: its element type and its shape
Message = bytes | memoryview  # of Protocol Buffers


def detect_maps(
    images: Images,
    model_path: Path | str,
    preset: Preset | str | None = None,
    scale: float = 1.0,
    flip: bool | str = False,
    threads: int | None = None,
    report: Progress | None = None,
) -> list[np.ndarray]:
    """Edge maps of images, (H, W) uint8 each, 255 = certainly an edge; in order.

    images: (H, W, 3) RGB arrays, uint8 or float in 0..1, alpha composited. model_path: the ONNX file.
    preset: a key of PRESETS, a Preset, or None: the key that the file's name holds. scale: the network sees the image
    so many times larger; its map is resampled back. flip: average with the mirrored image; "both": mirrored
    horizontally, vertically and both. threads: None for as many as there are. report: Progress.
    """
    assert scale > 0 and flip in FLIPS, (scale, flip)
    report = report or Progress()
    signature = read_signature(model_path)
    preset = preset_for(model_path, preset)
    output = _output_index(model_path, signature, preset)
    if signature.makers[output] == "Sigmoid":
        preset = replace(preset, sigmoid=False)  # exported with it, whatever the authors' code does
    network = _Network(Path(model_path), signature, signature.outputs[output], threads, report)
    maps = []
    with _opencv_threads(threads), report.track("detecting edges", len(images)) as done:
        for index, image in enumerate(images):
            maps.append(_detect(image, network, preset, scale, FLIPS[flip]))
            done(index + 1)
    return maps


def preset_for(model_path: Path | str, preset: Preset | str | None = None) -> Preset:
    """The Preset of a model: `preset` itself, the row of that name, or the row whose name the file's name holds."""
    if isinstance(preset, Preset):
        return preset
    names = ", ".join(PRESETS)
    if preset:
        if preset.lower() not in PRESETS:
            hint = did_you_mean(preset.lower(), PRESETS) or f"; there is {names}"
            raise UserError(f"source.onnx.network: '{preset}' is not a known network{hint}")
        return PRESETS[preset.lower()]
    # At the start of a word: 'published.onnx' is no HED.
    found = [name for name in PRESETS if re.search(rf"(?<![a-z]){name}", Path(model_path).stem.lower())]
    if len(found) != 1:
        why = f"holds {' and '.join(found)}" if found else "does not say which network this is"
        raise UserError(f"{model_path}: the file's name {why}; set source.onnx.network to one of {names}")
    return PRESETS[found[0]]


def _detect(
    image: np.ndarray, network: "_Network", preset: Preset, scale: float, flips: Sequence[tuple[int, ...]]
) -> np.ndarray:
    """(H, W) uint8 of one image."""
    height, width = image.shape[:2]
    seen = (round(width * scale), round(height * scale)) if scale != 1 else (width, height)
    pixels = np.clip(_resampled(_as_pixels(image), seen), 0.0, 255.0)  # cubics overshoot
    ordered = pixels if preset.rgb else pixels[:, :, ::-1]
    planes = (ordered - np.array(preset.mean, np.float32)) / np.array(preset.deviation, np.float32)
    tile = [
        fixed or min(-(-side // preset.multiple) * preset.multiple, MAX_TILE)
        for side, fixed in zip(planes.shape[:2], network.signature.size, strict=True)
    ]

    def infer(blob: np.ndarray) -> np.ndarray:
        runs = [np.flip(_as_map(network, np.flip(blob, axes), preset), axes) for axes in flips]
        return np.mean(runs, axis=0)

    found = _in_tiles(np.ascontiguousarray(planes.transpose(2, 0, 1)), tile, infer)
    return np.rint(np.clip(_resampled(found, (width, height)), 0.0, 1.0) * 255).astype(np.uint8)


def _as_pixels(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 in 0..255."""
    assert image.ndim == 3 and image.shape[2] == 3, image.shape
    return image.astype(np.float32) if image.dtype == np.uint8 else (image * 255.0).astype(np.float32)


def _resampled(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A float32 image brought to `size`, (width, height) px.

    cv2.resize lays the borders of the first and last pixels over each other, not their centres, so what is drawn in
    the image stays where it is, in shares of its size. Means of areas, not samples, where it becomes smaller.
    """
    if (image.shape[1], image.shape[0]) == tuple(size):
        return image
    smaller = size[0] < image.shape[1]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)


def _in_tiles(planes: np.ndarray, tile: Sequence[int], infer: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """(h, w) map of an image, in tiles that fade into each other; an image smaller than a tile repeats its border.

    planes: (3, h, w) float32. tile: (rows, columns) px. infer: (1, 3, *tile) -> (*tile,).
    """
    height, width = planes.shape[1:]
    missing = [(0, max(side - have, 0)) for side, have in zip(tile, (height, width), strict=True)]
    padded = np.pad(planes, [(0, 0), *missing], mode="edge")
    total, weight = np.zeros((2, *padded.shape[1:]), np.float32)
    share = np.outer(*(_fade(side) for side in tile))
    for top in _tile_starts(padded.shape[1], tile[0]):
        for left in _tile_starts(padded.shape[2], tile[1]):
            rows, columns = slice(top, top + tile[0]), slice(left, left + tile[1])
            total[rows, columns] += share * infer(np.ascontiguousarray(padded[None, :, rows, columns]))
            weight[rows, columns] += share
    return (total / weight)[:height, :width]


def _tile_starts(size: int, tile: int) -> list[int]:
    """First pixels of tiles that cover `size` pixels and share TILE_OVERLAP or more."""
    count = 1 if size <= tile else -(-(size - TILE_OVERLAP) // (tile - TILE_OVERLAP))
    return [round(start) for start in np.linspace(0, size - tile, count)]


def _fade(tile: int) -> np.ndarray:
    """(tile,) weights: 1, and falling to nearly 0 over the overlap with a neighbour."""
    to_border = np.minimum(np.arange(tile), np.arange(tile)[::-1]) + 0.5
    return np.minimum(to_border / TILE_OVERLAP, 1.0).astype(np.float32)


def _as_map(network: "_Network", blob: np.ndarray, preset: Preset) -> np.ndarray:
    """The network's answer to (1, 3, h, w) as (h, w) float in 0..1."""
    answer = np.asarray(network.forward(np.ascontiguousarray(blob)), dtype=np.float32)
    size, where = blob.shape[2:], f"{network.path}: output '{network.output}'"
    if answer.shape[-2:] != size or answer.size != np.prod(size):
        found, wanted = (" x ".join(map(str, sides)) or "a number" for sides in (answer.shape, (1, 1, *size)))
        raise UserError(f"{where} is {found}, not one map in the size of the image, {wanted}; choose another output")
    answer = answer.reshape(size)
    if not (np.abs(answer) < HUGE).all():
        raise UserError(f"{where} is not finite; export the model again, in float32, or choose another output")
    if preset.sigmoid:
        return 1.0 / (1.0 + np.exp(-np.clip(answer, -80.0, 80.0)))  # beyond, exp leaves float32
    answer = answer / preset.full
    low, high = float(answer.min()), float(answer.max())
    if low < -RANGE_TOLERANCE or high > 1 + RANGE_TOLERANCE:
        span = f"ranges from {low * preset.full:.3g} to {high * preset.full:.3g}, not from 0 to {preset.full:g}"
        raise UserError(f"{where} {span}; export the model with its sigmoid, or check which network it is (model)")
    return answer


class _Network:
    """A function from (1, 3, h, w) float32 to one output: by OpenCV, from its first refusal on by onnxruntime."""

    def __init__(self, path: Path, signature: Signature, output: str, threads: int | None, report: Progress) -> None:
        self.path, self.signature, self.output = path, signature, output
        self.threads, self.report = threads, report
        self.session: Any = None  # onnxruntime's, from OpenCV's first refusal on
        try:
            with _quiet_opencv():
                self.net = cv2.dnn.readNetFromONNX(str(path))
        except cv2.error as error:
            self._change_over(error)

    def forward(self, blob: np.ndarray) -> np.ndarray:
        """blob: (1, 3, h, w) float32, contiguous. Returns the output as it comes."""
        if self.session is None:
            try:
                with _quiet_opencv():
                    self.net.setInput(blob)
                    return self.net.forward(self.output)
            except cv2.error as error:
                self._change_over(error)
        try:
            return self.session.run([self.output], {self.signature.input: blob})[0]
        except Exception as error:  # its classes are not part of its interface
            raise self._refused_by_both(error) from error

    def _change_over(self, error: Exception) -> None:
        self.reason = condensed(error)
        try:
            runtime = importlib.import_module("onnxruntime")
        except ImportError:
            cure = "try onnxruntime (pip install onnxruntime), which is then used by itself"
            raise UserError(f"{self.path}: OpenCV {cv2.__version__} cannot run it: {self.reason}; {cure}") from error
        self.report.say(f"{self.path.name}: OpenCV cannot run it ({self.reason}); onnxruntime does")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = self.threads or 0  # 0: as many as there are
        try:
            self.session = runtime.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as second:  # its classes are not part of its interface
            raise self._refused_by_both(second) from second

    def _refused_by_both(self, error: Exception) -> UserError:
        reasons = f"OpenCV: {self.reason}; onnxruntime: {condensed(error)}"
        return UserError(f"{self.path}: cannot be run ({reasons}); export the model again, or make the images smaller")


def condensed(error: Exception) -> str:
    """The reason in another library's message: the operator where it names one, else its last statement."""
    text = " ".join(str(error).split())
    if unknown := re.search(r'of type "(\w+)"', text):
        return f"its operator {unknown[1]} is not supported"
    if failing := re.search(r"Node \[(\w+)@", text):
        return f"its operator {failing[1]} fails"
    statement = re.split(r"error: \(-?\d+:[^)]*\) ", text)[-1]
    statement = re.sub(r" in function '[^']*'.*", "", statement)
    return statement[:LONGEST_REASON].rstrip(" >")


@contextlib.contextmanager
def _quiet_opencv() -> Iterator[None]:
    """OpenCV logs what it also raises; a user is to read it once."""
    log = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging  # OpenCV 4 has it here, OpenCV 5 there
    before = log.getLogLevel()
    try:
        log.setLogLevel(SILENT)
        yield
    finally:
        log.setLogLevel(before)


@contextlib.contextmanager
def _opencv_threads(threads: int | None) -> Iterator[None]:
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(before if threads is None else threads)
        yield
    finally:
        cv2.setNumThreads(before)


def _output_index(path: Path | str, signature: Signature, preset: Preset) -> int:
    count = len(signature.outputs)
    if not -count <= preset.output < count:
        problem = f"there is no output {preset.output}; it has {count}, from 0 to {count - 1}"
        raise UserError(f"{path}: {problem} ({', '.join(signature.outputs)}); -1 is the last one")
    return preset.output


def read_signature(path: Path | str) -> Signature:
    """What an ONNX file declares about its input and outputs; refused unless it maps one RGB image to something.

    The file is a Protocol Buffers message (github.com/onnx/onnx: onnx.proto); the few fields wanted are read here.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except FileNotFoundError as error:
        near = did_you_mean(path.name, [p.name for p in path.parent.glob("*.onnx")]) if path.parent.is_dir() else ""
        raise UserError(f"{path}: not found{near}; name the ONNX file of an edge detector") from error
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; name the ONNX file of an edge detector") from error
    foreign = [what for start, what in FOREIGN.items() if content.startswith(start)]
    if foreign:
        raise UserError(f"{path}: not an ONNX file but {foreign[0]}")
    try:
        inputs, outputs, makers = _declared(content)
    except (ValueError, TypeError, LookupError) as error:
        raise UserError(f"{path}: not an ONNX file, or damaged; download or export it again") from error
    if not outputs:
        raise UserError(f"{path}: not an ONNX file of a network: it declares no output; export it again")
    name, size = _image_input(path, inputs)
    return Signature(name, size, outputs, tuple(makers.get(output, "") for output in outputs))


def _image_input(path: Path, inputs: dict[str, Described]) -> tuple[str, tuple[int | None, int | None]]:
    """The name of the one input and its (height, width), each None where it is free."""
    if len(inputs) != 1:
        raise UserError(f"{path}: it has {len(inputs)} inputs; an edge detector takes one image")
    ((name, (kind, shape)),) = inputs.items()
    described = " x ".join(str(side or "?") for side in shape)
    if len(shape) != 4 or shape[0] not in (None, 1) or shape[1] not in (None, 3):
        raise UserError(f"{path}: its input is {described}; one RGB image is 1 x 3 x height x width: export it so")
    if kind != FLOAT32:
        raise UserError(f"{path}: its input is not float32 numbers; export the model in float32")
    height, width = shape[2:]
    if any(side is not None and side < MIN_TILE for side in (height, width)):
        problem = f"its input is {described} px, and {MIN_TILE} px are the least"
        raise UserError(f"{path}: {problem}; export it with free height and width (dynamic_axes)")
    return name, (height, width)


def _declared(content: bytes) -> tuple[dict[str, Described], tuple[str, ...], dict[str, str]]:
    """Inputs {name: (type, shape)}, names of the outputs and {name of a value: operator} of an ONNX model."""
    graphs = [value for number, value in _fields(memoryview(content)) if number == 7]  # ModelProto.graph
    inputs: dict[str, Described] = {}
    outputs: list[str] = []
    weights: set[str] = set()
    makers: dict[str, str] = {}
    for number, value in _fields(graphs[0]):
        if number == 1:  # GraphProto.node: output = 2, op_type = 4
            node = list(_fields(value))
            operator = next((_text(part) for key, part in node if key == 4), "")
            makers.update((_text(part), operator) for key, part in node if key == 2)
        elif number == 5:  # initializer: name = 8
            weights.update(_text(part) for key, part in _fields(value) if key == 8)
        elif number == 11:  # input
            name, described = _value(value)
            inputs[name] = described
        elif number == 12:  # output
            outputs.append(_value(value)[0])
    # Old files declare the weights as inputs as well.
    return {name: described for name, described in inputs.items() if name not in weights}, tuple(outputs), makers


def _value(message: Message) -> tuple[str, Described]:
    """Name and (element type, shape with None for what is free) of a ValueInfoProto."""
    parts = dict(_fields(message))
    tensor = dict(_fields(dict(_fields(parts[2]))[1])) if 2 in parts else {}  # type = 2, its tensor_type = 1
    sides = [dict(_fields(side)).get(1) for number, side in _fields(tensor.get(2, b"")) if number == 1]  # shape = 2
    return _text(parts[1]), (tensor.get(1), tuple(side if side and 0 < side < MAX_SIDE else None for side in sides))


def _text(value: Message) -> str:
    return bytes(value).decode("utf-8")


def _fields(message: Message) -> Iterator[tuple[int, Any]]:
    """(number, value) of the fields of a Protocol Buffers message; a value is an int or the bytes."""
    value: int | Message
    place = 0
    while place < len(message):
        key, place = _varint(message, place)
        kind = key & 7
        if kind == 0:
            value, place = _varint(message, place)
        else:
            if kind == 2:
                size, place = _varint(message, place)
            else:
                size = {1: 8, 5: 4}.get(kind, -1)
            if size < 0 or place + size > len(message):
                raise ValueError(f"no field at byte {place}")
            value, place = message[place : place + size], place + size
        yield key >> 3, value


def _varint(message: Message, place: int) -> tuple[int, int]:
    """An integer of 7 bits a byte, the lowest first, and the place behind it."""
    value = shift = 0
    while shift < 64:
        byte = message[place]
        value, shift, place = value | (byte & 127) << shift, shift + 7, place + 1
        if byte < 128:
            return value, place
    raise ValueError(f"no integer at byte {place}")
