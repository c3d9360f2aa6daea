"""Images and edge maps without the distortion of their lenses, made once and kept."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from taichi_edges.photogrammetry import undistorted, undistortion_map

FOLDERS = {"image_paths": "images", "edge_paths": "edges", "mask_paths": "masks"}


def undistorted_frames(frames, folder):
    """Frames whose files lie undistorted in `folder`."""
    paths = {key: [] for key in FOLDERS}
    intrinsics = []
    for index, lens in enumerate(frames.lenses):
        matrix, size = undistorted(lens)
        maps = undistortion_map(lens, matrix, size)
        intrinsics.append(lambda width, height, matrix=matrix: matrix)
        for key, name in FOLDERS.items():
            path = getattr(frames, key)[index]
            if not path:
                paths[key].append("")
                continue
            target = folder / name / f"{Path(path).stem}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(target), cv2.remap(image, maps, None, cv2.INTER_CUBIC))
            paths[key].append(target)
    return replace(frames, intrinsics=intrinsics, lenses=None, **paths)
