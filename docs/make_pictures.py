"""Makes the README's pictures from finished runs: `python docs/make_pictures.py RUN_FOLDER VIEW[,VIEW ...] OUT.png`.

Panels of one view, cropped to the scene: the edge map the training saw, the oriented points coloured by cluster, and
the edges over the view's picture. Edge maps and pictures are shown only where the run has rendered them itself. Of
several views, as of a building, the edges alone, in full. Those of the README:

    python run.py scenes/demo.yaml --set source.size=800
    python docs/make_pictures.py runs/demo demo_000 docs/images/demo.png
    python run.py scenes/abc_00004926_images.yaml
    python docs/make_pictures.py runs/abc_00004926_images 0_colors docs/images/abc_00004926.png
    python run.py scenes/castle_p19.yaml
    python docs/make_pictures.py runs/castle_p19 0006,0000 docs/images/castle_p19.png
"""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from taichi_edges.exporters.overlays import background, draw_edges
from taichi_edges.files.palette import label_colours
from taichi_edges.geometry.wireframe import read_wireframe
from taichi_edges.strokes.clusters import read_clusters
from taichi_edges.views.views import read_views

PANEL, WIDE_PANEL = 420, 760  # px
MARGIN = 0.08  # of the panel, around the edges
GAP = 24  # px between the panels of several views, whose lines would run into each other


def crop_of(pixels, size):
    """(left, top, side) of the square around the pixels, with a margin, inside an image of `size` (width, height)."""
    low, high = np.nanmin(pixels, axis=0), np.nanmax(pixels, axis=0)
    side = int(np.ceil((high - low).max() * (1 + 2 * MARGIN)))
    left, top = np.clip(((low + high) / 2 - side / 2).astype(int), 0, np.maximum(np.array(size) - side, 0))
    return left, top, side


def draw_points(shape, pixels, colours):
    """White picture with a dot at each of the (n, 2) pixels."""
    picture = np.full((*shape, 3), 255, np.uint8)
    for (u, v), colour in zip(pixels, colours, strict=True):
        if np.isfinite(u + v):
            centre = (round(u * 16), round(v * 16))
            cv2.circle(picture, centre, 22, [int(c) for c in colour[::-1]], -1, cv2.LINE_AA, 4)
    return picture


def draw_views(folder, names, out):
    """Write the edges of the run in `folder` as each of the named views sees them, side by side."""
    views = read_views(folder / "views.npz")
    wireframe = read_wireframe(folder / "edges.json")
    wireframe = wireframe.transformed(views.similarity.to_unit, views.similarity.scale)
    panels = []
    for name in names:
        view = views.names.index(name)
        canvas = np.full((views.height, views.width, 3), 255, np.uint8)
        drawn = draw_edges(canvas, views.intrinsics[view] @ views.world_to_camera[view], wireframe)
        height = round(WIDE_PANEL * views.height / views.width)
        panel = cv2.resize(drawn, (WIDE_PANEL, height), interpolation=cv2.INTER_AREA)
        panels += [panel, np.full((height, GAP, 3), 255, np.uint8)]
    cv2.imwrite(str(out), np.hstack(panels[:-1]))


def main(folder, view_name, out):
    """Write the picture of one view of the run in `folder`."""
    folder = Path(folder)
    if "," in view_name:
        draw_views(folder, view_name.split(","), out)
        return
    views = read_views(folder / "views.npz")
    view = views.names.index(view_name)
    wireframe = read_wireframe(folder / "edges.json")
    wireframe = wireframe.transformed(views.similarity.to_unit, views.similarity.scale)
    clusters = read_clusters(folder / "clusters.npz")
    shape = (views.height, views.width)
    edge_map = cv2.cvtColor(255 - views.edge_maps[view], cv2.COLOR_GRAY2BGR)
    dots = draw_points(shape, views.project(clusters.points, view)[0], label_colours(clusters.labels))
    own_picture = folder / "images" / f"{view_name}.png"
    if own_picture.exists():
        canvas = background(replace(views, image_paths=(str(own_picture),) * len(views)), view)
    else:
        canvas = np.full((*shape, 3), 255, np.uint8)
    drawn = draw_edges(canvas, views.intrinsics[view] @ views.world_to_camera[view], wireframe)
    left, top, side = crop_of(views.project(wireframe.edge_set().sample(0.01)[0], view)[0], (views.width, views.height))
    panels = [image[top : top + side, left : left + side] for image in (edge_map, dots, drawn)]
    panels = panels if own_picture.exists() else panels[1:]
    cv2.imwrite(out, np.hstack([cv2.resize(panel, (PANEL, PANEL), interpolation=cv2.INTER_AREA) for panel in panels]))


if __name__ == "__main__":
    main(*sys.argv[1:])
