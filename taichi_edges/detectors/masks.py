"""Masks: edgels outside what the masks show are dropped."""

import cv2
import numpy as np

RIM_PX = 6  # by which a mask grows before it cuts: outlines lie on its border


def within_masks(edgels, mask_paths, size):
    """The edgels inside the masks. size: (width, height)."""
    keep = np.ones(len(edgels), bool)
    for view, path in enumerate(mask_paths):
        if not path:
            continue
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        mask = cv2.dilate(mask, np.ones((2 * RIM_PX + 1,) * 2, np.uint8)) >= 128
        part = slice(edgels.starts[view], edgels.starts[view + 1])
        u, v = np.rint(edgels.points[part]).astype(int).T
        keep[part] = mask[np.clip(v, 0, size[1] - 1), np.clip(u, 0, size[0] - 1)]
    return edgels.keep(keep)
