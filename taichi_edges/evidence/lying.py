"""Which edgels lie on an edge, and which only about it.

An edge stays where it is as the viewpoint moves: the edgels about it lie on it. The occluding contour of a smooth
surface leaves any place in space, so that its edgels lie all around. The share of the edgels about a place that lie on
it is its steadiness. Who counts differs: an edgel that another edge explains says nothing.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from taichi_edges.evidence.edgel_matching import EdgelMatching

Counts = TypeVar("Counts", float, np.ndarray)


@dataclass(frozen=True)
class EdgelsAbout:
    """The edgels that n oriented places have about them in v views.

    edgels: (n, v) index into Edgels, -1 where there is none. residuals: (n, v) float32, px across the edgel, signed.
    inside: (n, v) bool, whether the view has the place in its image.
    """

    edgels: np.ndarray
    residuals: np.ndarray
    inside: np.ndarray

    @staticmethod
    def of(
        matching: "EdgelMatching",
        points: np.ndarray,
        directions: np.ndarray,
        radius: float,
        views: slice | None = None,
    ) -> "EdgelsAbout":
        """Those within `radius` px. matching: EdgelMatching. points, directions: (n, 3). views: a slice, None: all."""
        views = slice(0, matching.edgels.view_count) if views is None else views
        return EdgelsAbout(*matching.matches(points, directions, views, radius))

    def keep(self, some: slice) -> "EdgelsAbout":
        """Those of some of the places."""
        return EdgelsAbout(self.edgels[some], self.residuals[some], self.inside[some])

    @property
    def there(self) -> np.ndarray:
        """(n, v) bool: where there is an edgel."""
        return self.edgels >= 0

    def within(self, px: float) -> np.ndarray:
        """(n, v) bool: where there is an edgel no farther than so many pixels across."""
        return self.there & (np.abs(self.residuals) <= px)

    def closeness(self, px: float) -> np.ndarray:
        """(n, v) of the edgels: 1 on the place, 0 from so many pixels across on, and where there is none."""
        return np.where(self.there, 1.0 - np.minimum((self.residuals / px) ** 2, 1.0), 0.0)


def steadiness(on: Counts, about: Counts) -> Counts:
    """The share of the edgels about places that lie on them; 0 where there are none. on, about: counts, alike."""
    return on / np.maximum(about, 1)
