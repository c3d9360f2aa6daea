"""How near to exact edges are the edgels of the sub-pixel detector, and how many does it find?

    python -m benchmarks.detector [scene ...]

The exact CAD edges of three scenes are projected into their views. TAICHI_EDGES_DATA names the folder of the scenes.
What is hidden is known where there is a mesh; for 00004926, an edge counts as visible where DexiNed's map has a ridge
within 3 px. Edgels near occluding contours, or near the outline, are not false. An edge stands alone when no other runs
within 2 px of it.
"""

import json
import os
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from taichi_edges.detectors.ridges import ridge_points
from taichi_edges.detectors.subpixel import trace_pictures
from taichi_edges.geometry.bezier import evaluate_bezier
from taichi_edges.synthetic.visibility import sample_segments
from taichi_edges.views.cameras import OPENGL_TO_OPENCV, inside_image, invert_pose, project

SPACING = 0.002  # scene units between samples of an edge; about half a pixel
HIDDEN = 0.004  # scene units; a surface so much in front of a sample hides it
APART = (0.75, 1.25, 1.75)  # px to both sides of an edge: with another edge there, the two are too close to tell apart
JITTER = 0.002  # scene units; a sample is seen when a point so near to it is
STEP = 0.02  # scene units; a jump of the depth from pixel to pixel that is an occluding contour
NEAR_PX, FAR_PX = 1.0, 3.0  # a true edge is found within NEAR_PX; an edgel farther than FAR_PX from every edge is false
CLOSE_PX = 0.6  # an offset that counts for the mean shift; larger ones are of another edge
PARALLEL = np.cos(np.radians(30.0))  # an edgel measures an edge that runs as it does


def read_emap(folder, images):
    """Names, image paths, intrinsics (V, 3, 3), world_to_camera (V, 3, 4)."""
    frames = json.loads((folder / "meta_data.json").read_text())["frames"]
    names = [frame["rgb_path"] for frame in frames]
    poses = invert_pose(np.array([frame["camtoworld"] for frame in frames]))
    return names, [folder / images / name for name in names], np.array([f["intrinsics"] for f in frames]), poses


def read_nerf(folder, images):
    """As read_emap, of the train split."""
    frames = json.loads((folder / "transforms_train.json").read_text())["frames"]
    names = [Path(frame["file_path"]).name + ".png" for frame in frames]
    poses = invert_pose(np.array([frame["transform_matrix"] for frame in frames]) @ OPENGL_TO_OPENCV)
    return names, [folder / images / name for name in names], np.array([f["camera_intrinsics"] for f in frames]), poses


def sharp_curves(path):
    """Samples (n, 3) of the CAD edges and the unit tangents (n, 3) there."""
    content = json.loads(path.read_text())
    if "curves" in content:
        lines = [np.array(curve["points"]) for curve in content["curves"]]
    else:
        controls = [np.array(edge["p"]) for edge in content["edges"]]
        lines = [c if len(c) == 2 else evaluate_bezier(c, np.linspace(0, 1, 65)) for c in controls]
    starts, ends = (np.concatenate([line[part] for line in lines]) for part in (np.s_[:-1], np.s_[1:]))
    points, owners = sample_segments(starts, ends, SPACING)
    tangents = (ends - starts)[owners]
    return points, tangents / np.linalg.norm(tangents, axis=1, keepdims=True)


def read_mesh(folder):
    """Ray-casting scene of the object's mesh in the scene's frame, or None."""
    import open3d

    found = [*folder.glob("mesh.ply"), *folder.glob("gt/*.obj")]
    if not found:
        return None
    mesh = open3d.io.read_triangle_mesh(str(found[0]))
    if found[0].suffix == ".obj":
        frame = json.loads((folder / "gt/curves.json").read_text())
        vertices = np.asarray(mesh.vertices) * frame["scale"] + frame["offset"]
        mesh.vertices = open3d.utility.Vector3dVector(vertices)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return scene


def seen_on_mesh(mesh, points, centre):
    """(n,) bool: is any of some points around each sample in sight from the centre (3,)?"""
    seen = np.zeros(len(points), bool)
    for offset in JITTER * np.concatenate([np.eye(3), -np.eye(3)]):
        ways = points + offset - centre
        rays = np.concatenate([np.broadcast_to(centre, ways.shape), ways], axis=1).astype(np.float32)
        reached = mesh.cast_rays(rays)["t_hit"].numpy() * np.linalg.norm(ways, axis=1)
        seen |= reached > np.linalg.norm(ways, axis=1) - HIDDEN
    return seen


def contour_pixels(mesh, lens, pose, shape):
    """(n, 2) pixels at which the depth jumps: outlines and occluding contours."""
    rows, columns = np.indices(shape)
    towards = np.stack([columns, rows, np.ones(shape)], axis=-1) @ np.linalg.inv(lens).T @ pose[:, :3]
    centre = np.broadcast_to(-pose[:, :3].T @ pose[:, 3], towards.shape)
    depth = mesh.cast_rays(np.concatenate([centre, towards], axis=-1).astype(np.float32))["t_hit"].numpy()
    depth = np.minimum(depth, 100.0)
    low, high = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    return np.argwhere(high - low > STEP)[:, ::-1]


def seen_on_map(path, pixels):
    """(n,) bool: has a learned detector's map a ridge within FAR_PX of the pixels?"""
    ridges = ridge_points(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), 0.8, 0.3)[0]
    return cKDTree(ridges).query(pixels)[0] < FAR_PX


def outline_sides(alpha, pixels, normals):
    """(n,) of the normals: +1 where it points out of the object, -1 where into it, 0 where both sides are object."""
    height, width = alpha.shape

    def covered(offset):
        places = np.rint(pixels + offset * normals).astype(int)
        return alpha[places[:, 1].clip(0, height - 1), places[:, 0].clip(0, width - 1)] > 127

    return covered(-2.5).astype(int) - covered(2.5)


def stands_alone(pixels, normals):
    """(n,) bool: does no other edge run within 2 px of the (n, 2) pixels of true edges, across their (n, 2) normals?"""
    tree = cKDTree(pixels)
    alone = np.ones(len(pixels), bool)
    for offset in APART:
        for side in (-offset, offset):
            alone &= tree.query(pixels + side * normals)[0] > 0.3
    return alone


def truth_in_view(truth, size, mesh, lens, pose, map_path):
    """Pixels (n, 2) of the visible samples of the true edges, and the unit normals (n, 2) of the edges there."""
    points, tangents = truth
    pixels, _ = project(points, lens, pose)
    ahead, _ = project(points + 1e-4 * tangents, lens, pose)
    seen = inside_image(pixels, *size)
    if mesh:
        seen &= seen_on_mesh(mesh, points, -pose[:, :3].T @ pose[:, 3])
    else:
        seen[seen] = seen_on_map(map_path, pixels[seen])
    along = (ahead - pixels)[seen]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return pixels[seen], np.stack([-along[:, 1], along[:, 0]], axis=1)


def outline_pixels(alpha):
    """(n, 2) pixels along the outline of the object."""
    return np.argwhere(cv2.morphologyEx(alpha, cv2.MORPH_GRADIENT, np.ones((3, 3))) > 127)[:, ::-1]


def measure_view(edgels, truth, image, mesh, lens, pose, map_path):
    """Columns of one view, as `report` wants them: of the true points, of all edgels, of those near a true edge."""
    height, width = image.shape[:2]
    alpha = image[:, :, 3]
    pixels, normals = truth_in_view(truth, (width, height), mesh, lens, pose, map_path)
    sides = outline_sides(alpha, pixels, normals)
    alone = stands_alone(pixels, normals)
    points, directions, _ = edgels
    contours = contour_pixels(mesh, lens, pose, (height, width)) if mesh else outline_pixels(alpha)
    to_truth, nearest = cKDTree(pixels).query(points)
    cosines = np.abs((directions * normals[nearest]).sum(axis=1))
    good = (to_truth < 2.0) & (cosines > PARALLEL)
    return {
        "away": cKDTree(points).query(pixels)[0],
        "alone": alone,
        "crease": alone & (sides == 0),
        "lost": np.minimum(to_truth, cKDTree(contours).query(points)[0]) > FAR_PX,
        "offsets": ((points - pixels[nearest]) * normals[nearest]).sum(axis=1)[good],
        "normals": normals[nearest][good],
        "sides": sides[nearest][good],
        "angles": np.degrees(np.arccos(cosines[good].clip(max=1))),
        "length": len(points),
    }


def report(name, rows):
    """Print one line of Markdown for a scene, from what `measure_view` found in its views."""
    column = {key: np.concatenate([np.atleast_1d(row[key]) for row in rows]) for key in rows[0]}
    away, offsets, sides, normals = (column[key] for key in ("away", "offsets", "sides", "normals"))
    close = np.abs(offsets) < CLOSE_PX
    # The one shift (dx, dy) of all edgels that explains the offsets along the normals best.
    shift = np.linalg.lstsq(normals[close], offsets[close], rcond=None)[0]
    outward = np.median((offsets * sides)[(sides != 0) & close])
    chosen = (away, away[column["alone"]], away[column["crease"]])
    recalls = [f"{np.mean(some < NEAR_PX):.1%} / {np.mean(some < FAR_PX):.1%}" for some in chosen]
    cells = [
        name,
        f"{np.median(np.abs(offsets)):.3f} / {np.quantile(np.abs(offsets), 0.95):.2f}",
        f"{shift[0]:+.3f}, {shift[1]:+.3f}",
        f"{outward:+.3f}",
        *recalls,
        f"{column['lost'].mean():.1%}",
        f"{np.median(column['angles']):.1f}",
        f"{column['length'].mean():.0f}",
    ]
    print(f"| {' | '.join(cells)} |", flush=True)


SCENES = {
    "00004926": ("abc_nef_edge/00004926", read_emap, "color", "gt/curves.json", "edge_DexiNed"),
    "00000006": ("abc_nef/00000006", read_nerf, "train_img", "gt/curves.json", "train"),
    "plate": ("cad/plate", read_emap, "color", "gt_edges.json", None),
}
HEADER = """
| scene | normal error px, median / 95 % | shift dx, dy | outward at outlines | recall 1 px / 3 px \
| of edges that stand alone | of creases among them | false | angle, degrees | edgels a view |
|---|---|---|---|---|---|---|---|---|---|"""


def measure(scene):
    """Print the line of one scene; returns the seconds for the detection."""
    place, reader, images, truth_path, maps = SCENES[scene]
    folder = Path(os.environ["TAICHI_EDGES_DATA"]) / place
    names, paths, lenses, poses = reader(folder, images)
    truth, mesh = sharp_curves(folder / truth_path), read_mesh(folder)
    paths = [str(path) if path.is_file() else "" for path in paths]
    start = time.perf_counter()
    edgels, _ = trace_pictures(paths, threads=2)
    seconds = time.perf_counter() - start
    rows = []
    for view, path in enumerate(paths):
        if path:
            image = cv2.imread(path, cv2.IMREAD_UNCHANGED)
            map_path = folder / maps / names[view] if maps else None
            rows.append(measure_view(edgels.of_view(view), truth, image, mesh, lenses[view], poses[view], map_path))
    report(scene, rows)
    return seconds


if __name__ == "__main__":
    print(HEADER.strip())
    spent = {scene: measure(scene) for scene in sys.argv[1:] or SCENES}
    print("\nSeconds for all views: " + ", ".join(f"{scene} {seconds:.1f}" for scene, seconds in spent.items()))
