"""Pictures as an edge detector wants them: linear light, and the coverage by the object apart from its colour.

What a pixel half covered by an edge shows is half of the light of each side. Only in linear light does the edge
therefore lie where the value is half-way; in encoded (sRGB) values it seems to lie deeper on the dark side, by 0.2 px
between black and white even where the picture is as sharp as it can be.

A picture with transparency is not composited over any background: an object of that grey would lose its outline, and
every other background lays a strong edge over the creases next to the outline. The coverage (alpha) is a layer of its
own, in which outlines have full contrast whatever the object's colour; the colours are those of the object alone.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.views.light import SRGB_LINEAR, SRGB_OFFSET, SRGB_POWER, SRGB_SLOPE, light_of_srgb, srgb_of_light

SAME_SHAPE = 0.01  # an image whose aspect is off by more is not a picture of this view
TAIL_BYTES = 64  # some writers pad the file behind its end marker
# What a whole file ends with; a decoder alone may fill the missing rows of a truncated file with grey.
END_MARKERS = {".png": b"IEND\xaeB`\x82", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}


@dataclass(frozen=True)
class Picture:
    """light: (H, W, 1 or 3) float32, linear light of the object, 1 = white; 3 channels as OpenCV orders them, BGR.

    coverage: (H, W) float32, 0..1, the share of each pixel that the object covers; None where it covers all of them.
    Where it is 0, `light` means nothing. exponent: of the encoding, None for sRGB; what `levels_per_light` wants.
    """

    light: np.ndarray
    coverage: np.ndarray | None = None
    exponent: float | None = None


def levels_per_light(light: np.ndarray, exponent: float | None = None) -> np.ndarray:
    """Grey levels of 255 by which the encoded value grows per unit of light, float32, same shape as `light`.

    exponent: None for sRGB.
    """
    bend, scale, power = SRGB_LINEAR / SRGB_SLOPE, 1 + SRGB_OFFSET, SRGB_POWER
    if exponent is not None:
        bend, scale, power = 255.0**-exponent, 1.0, exponent  # the light of one grey level; below, the slope is endless
    slope = np.maximum(light, np.float32(bend)) ** np.float32(1 / power - 1)
    slope *= 255 * scale / power
    return slope


def as_picture(image: np.ndarray, exponent: float | None = None) -> Picture:
    """Picture of a decoded image, (H, W), (H, W, 1), (H, W, 3) BGR, or with straight alpha (H, W, 2) or (H, W, 4).

    8 and 16 bits are sRGB-encoded, which is what PNG and JPEG files of either depth hold unless they say otherwise;
    floats (EXR, HDR, TIFF) are linear light, 1 = white. Alpha is linear in all of them.
    exponent: light = value ** exponent instead of sRGB, for images that are encoded otherwise: 1 where edges were
    smoothed in the encoded values, as drawing programs do; 5 to 7 resembles the "Filmic" tones of Blender.
    """
    image = image[:, :, None] if image.ndim == 2 else image
    colours = image.shape[2] - (image.shape[2] in (2, 4))
    light = _decoded(image[:, :, :colours], exponent)
    if colours == image.shape[2]:
        return Picture(light, exponent=exponent)
    full = 1.0 if image.dtype.kind == "f" else np.iinfo(image.dtype).max
    coverage = np.clip(image[:, :, -1].astype(np.float32) / full, 0.0, 1.0)
    return Picture(light, None if coverage.min() == 1.0 else coverage, exponent)


def _decoded(values: np.ndarray, exponent: float | None) -> np.ndarray:
    """(H, W, C) float32 linear light."""
    if values.dtype.kind == "f":
        return np.nan_to_num(values.astype(np.float32), nan=0.0, posinf=1.0, neginf=0.0)
    shades = np.linspace(0.0, 1.0, np.iinfo(values.dtype).max + 1)
    return (light_of_srgb(shades) if exponent is None else (shades**exponent).astype(np.float32))[values]


def read_picture(path: Path | str, exponent: float | None = None) -> Picture:
    """Picture of an image file; UserError where it cannot be read. exponent: see `as_picture`."""
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path}: no such image; check the folder of the images, or leave this view out")
    whole = is_whole(path)
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if whole else None
    if image is None:
        problem = "not an image that can be read" if whole else "the image is truncated"
        raise UserError(f"{path}: {problem}; copy or export it again, or leave this view out")
    if image.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise UserError(f"{path}: pixels of type {image.dtype}; export it with 8 or 16 bits a channel")
    return as_picture(image, exponent)


def read_colour(path: Path | str) -> np.ndarray | None:
    """An image as people and learned detectors see it: (H, W, 3) uint8 BGR, what is transparent over white.

    Composited in linear light. None where the file cannot be read.
    """
    try:
        image = cv2.imdecode(np.frombuffer(Path(path).read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    except (OSError, cv2.error):  # not there, not ours to read, or empty
        return None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        return None
    full = 255 if image.dtype == np.uint8 else 65535
    colour = image if full == 255 else (image * (255.0 / full)).round().astype(np.uint8)
    if image.ndim == 2:
        return cv2.cvtColor(colour, cv2.COLOR_GRAY2BGR)
    if image.shape[2] == 3:
        return colour
    colour, alpha = cv2.cvtColor(colour, cv2.COLOR_BGRA2BGR), cv2.extractChannel(image, 3)
    colour[alpha == 0] = 255
    mixed = (alpha > 0) & (alpha < full)  # few, along outlines
    share = (alpha[mixed, None] / full).astype(np.float32)
    light = light_of_srgb(image[mixed, :3] / full) * share + (1 - share)
    colour[mixed] = (255 * srgb_of_light(light)).round()
    return colour


def is_whole(path: Path) -> bool:
    """Does the file end as a whole file of its kind ends? Formats without a known end marker pass."""
    marker, size = END_MARKERS.get(path.suffix.lower()), path.stat().st_size
    with open(path, "rb") as file:
        file.seek(max(size - TAIL_BYTES, 0))
        return size > 0 and (marker is None or marker in file.read())
