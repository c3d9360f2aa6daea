"""Width and height of an image file from its first bytes: decoding hundreds of photographs takes seconds.

Sizes are those of the stored pixels, which COLMAP uses; a note on how to turn the camera (EXIF) is not heeded.
"""

import struct
from pathlib import Path
from typing import BinaryIO

PNG_START = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8"
JPEG_BARE = {0x01, *range(0xD0, 0xD8)}  # markers without a length
JPEG_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # those that hold the size


def picture_size(path: Path | str) -> tuple[int, int] | None:
    """(width, height) in pixels; None where the file is not an image that can be read."""
    with open(path, "rb") as file:
        start = file.read(24)
        if start.startswith(PNG_START) and len(start) == 24:
            width, height = struct.unpack(">II", start[16:24])
            return width, height
        size = _jpeg_size(file) if start.startswith(JPEG_START) else None
    return size or _decoded_size(path)


def _jpeg_size(file: BinaryIO) -> tuple[int, int] | None:
    """Walks from segment to segment to the one that holds the size. ITU T.81, B.1 and B.2."""
    file.seek(2)
    while byte := file.read(1):
        if byte != b"\xff":
            return None
        while byte == b"\xff":
            byte = file.read(1)
        marker = byte[0] if byte else 0
        if marker in JPEG_BARE:
            continue
        head = file.read(7)
        if len(head) < 7:
            return None
        if marker in JPEG_FRAMES:
            height, width = struct.unpack(">HH", head[3:7])
            return (width, height) if width and height else None
        file.seek(struct.unpack(">H", head[:2])[0] - 7, 1)
    return None


def _decoded_size(path: Path | str) -> tuple[int, int] | None:
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return None if image is None else (image.shape[1], image.shape[0])
