"""Polylines as cameras see them: sampled evenly in one image, and at places that several can be asked about."""

from dataclasses import dataclass

import numpy as np

from taichi_edges.arrays.ranges import ragged
from taichi_edges.views.cameras import NEAR


@dataclass(frozen=True)
class Chords:
    """The chords of some polylines, one polyline after the other.

    starts, ends: (c, 3). owners: (c,) int, the polyline. travelled: (c + 1,) length of the chords before each, and
    of all.
    """

    starts: np.ndarray
    ends: np.ndarray
    owners: np.ndarray
    travelled: np.ndarray

    @staticmethod
    def of(polylines):
        """Of a list of (m, 3) polylines; chords of no length are left out."""
        starts = np.concatenate([np.zeros((0, 3)), *(polyline[:-1] for polyline in polylines)])
        ends = np.concatenate([np.zeros((0, 3)), *(polyline[1:] for polyline in polylines)])
        owners = np.repeat(np.arange(len(polylines)), [len(polyline) - 1 for polyline in polylines])
        lengths = np.linalg.norm(ends - starts, axis=1)
        some = lengths > 0
        return Chords(starts[some], ends[some], owners[some], np.concatenate([[0.0], np.cumsum(lengths[some])]))

    def __len__(self):
        return len(self.starts)

    def places(self, spacing):
        """The middles of equal stretches of about `spacing` along each polyline, one for each at least.

        Returns points (n, 3), unit tangents (n, 3), and (n,) the length travelled where each stretch ends.
        """
        first = np.flatnonzero(np.diff(self.owners, prepend=-1))
        begin, end = self.travelled[first], self.travelled[np.append(first, len(self))[1:]]
        counts = np.maximum(np.rint((end - begin) / spacing), 1).astype(np.int64)
        polyline, number = ragged(counts)
        step = ((end - begin) / counts)[polyline]
        middles, ends = begin[polyline] + (number + 0.5) * step, begin[polyline] + (number + 1) * step
        chord = np.clip(np.searchsorted(self.travelled, middles, side="right") - 1, 0, len(self) - 1)
        lengths = np.diff(self.travelled)[chord]
        vectors = (self.ends - self.starts)[chord] / lengths[:, None]
        return self.starts[chord] + (middles - self.travelled[chord])[:, None] * vectors, vectors, ends

    def in_image(self, camera, spacing):
        """Traces of the chords in an image, sampled at most `spacing` px apart. camera: Camera."""
        one, other = (camera.homogeneous(points) for points in (self.starts, self.ends))
        low, high = _inside(camera.planes @ one.T, camera.planes @ other.T)
        seen = np.flatnonzero(low < high)
        one, other, low, high = one[seen], other[seen], low[seen, None], high[seen, None]
        one, other = one + low * (other - one), one + high * (other - one)
        begin = one[:, :2] / one[:, 2:3]
        vectors = other[:, :2] / other[:, 2:3] - begin
        lengths = np.linalg.norm(vectors, axis=1)
        counts = np.maximum(np.ceil(lengths / spacing), 1).astype(np.int64)
        chord, number = ragged(counts)
        share = (number + 0.5) / counts[chord]
        pixels = begin[chord] + share[:, None] * vectors[chord]
        # Of a line in perspective: what is half-way in the image is nearer than half-way to its nearer end.
        near, far = one[chord, 2], other[chord, 2]
        share = share * near / (far + share * (near - far))
        share = low[chord, 0] + share * (high - low)[chord, 0]
        travelled = self.travelled[seen][chord] + share * np.diff(self.travelled)[seen][chord]
        along = vectors / np.maximum(lengths, 1e-300)[:, None]
        return Traces(pixels, along[chord], (lengths / counts)[chord], travelled)


@dataclass(frozen=True)
class Camera:
    """One view. intrinsics: (3, 3) pixels. world_to_camera: (3, 4). width, height: pixels."""

    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    width: int
    height: int

    @staticmethod
    def of(views, view):
        """That of one of some Views."""
        return Camera(views.intrinsics[view], views.world_to_camera[view], views.width, views.height)

    @property
    def centre(self):
        """(3,) where it stands."""
        return -self.world_to_camera[:, :3].T @ self.world_to_camera[:, 3]

    @property
    def planes(self):
        """(5, 4): the homogeneous images (u d, v d, d, 1) that are in sight have no negative product with any."""
        right, below = self.width - 0.5, self.height - 0.5
        return np.array([[0, 0, 1, -NEAR], [1, 0, 0.5, 0], [-1, 0, right, 0], [0, 1, 0.5, 0], [0, -1, below, 0]])

    def homogeneous(self, points):
        """(n, 4): u d, v d, d and 1 of (n, 3) points at depth d."""
        seen = (points @ self.world_to_camera[:, :3].T + self.world_to_camera[:, 3]) @ self.intrinsics.T
        return np.column_stack([seen, np.ones(len(points))])

    def project(self, points, directions):
        """(n, 2) pixels of (n, 3) points, (n, 2) unit images of their directions, and whether they are in sight."""
        seen, moved = self.homogeneous(points), directions @ (self.intrinsics @ self.world_to_camera[:, :3]).T
        inside = (self.planes @ seen.T >= 0).all(axis=0)
        depths = np.where(inside, seen[:, 2], 1.0)[:, None]
        pixels = seen[:, :2] / depths
        along = moved[:, :2] - pixels * moved[:, 2:]
        return pixels, along / np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None], inside


@dataclass(frozen=True)
class Traces:
    """Samples in one image. pixels, along: (n, 2), unit directions. lengths: (n,) px that each stands for. travelled:
    (n,) where on the Chords each is.
    """

    pixels: np.ndarray
    along: np.ndarray
    lengths: np.ndarray
    travelled: np.ndarray

    def __len__(self):
        return len(self.pixels)


def _inside(begin, end):
    """(c,) shares between which segments are on the right side of all planes; where low >= high they nowhere are.

    begin, end: (p, c) signed distances of their ends from the planes.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = begin / (begin - end)
    low = np.where((begin < 0) & (end >= 0), crossing, np.where(begin < 0, 1.0, 0.0)).max(axis=0)
    high = np.where((end < 0) & (begin >= 0), crossing, np.where(end < 0, 0.0, 1.0)).min(axis=0)
    return low, high
