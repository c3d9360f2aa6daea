"""Polylines as cameras see them: sampled evenly in one image, and at places that several can be asked about."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.arrays.ranges import ragged
from taichi_edges.views.cameras import shares_inside

if TYPE_CHECKING:
    from taichi_edges.views.cameras import Camera


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
    def of(polylines: Sequence[np.ndarray]) -> "Chords":
        """Of a list of (m, 3) polylines; chords of no length are left out."""
        starts = np.concatenate([np.zeros((0, 3)), *(polyline[:-1] for polyline in polylines)])
        ends = np.concatenate([np.zeros((0, 3)), *(polyline[1:] for polyline in polylines)])
        owners = np.repeat(np.arange(len(polylines)), [len(polyline) - 1 for polyline in polylines])
        lengths = np.linalg.norm(ends - starts, axis=1)
        some = lengths > 0
        return Chords(starts[some], ends[some], owners[some], np.concatenate([[0.0], np.cumsum(lengths[some])]))

    def __len__(self) -> int:
        return len(self.starts)

    def places(self, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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

    def in_image(self, camera: "Camera", spacing: float) -> "Traces":
        """Traces of the chords in an image, sampled at most `spacing` px apart. camera: Camera."""
        one, other = (camera.homogeneous(points) for points in (self.starts, self.ends))
        low, high = shares_inside(camera.planes @ one.T, camera.planes @ other.T)
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
class Traces:
    """Samples in one image. pixels, along: (n, 2), unit directions. lengths: (n,) px that each stands for. travelled:
    (n,) where on the Chords each is.
    """

    pixels: np.ndarray
    along: np.ndarray
    lengths: np.ndarray
    travelled: np.ndarray

    def __len__(self) -> int:
        return len(self.pixels)
