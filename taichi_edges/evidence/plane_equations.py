"""What the viewing planes of their edgels say of where points are: a set of normal equations for each point.

An edgel with normal m asks for m . (projection - edgel) = 0: a plane in space, of slope j = m^T dprojection/dpoint (px
per unit). With the residual r (px) and the weight w, the edgel's strength times Geman and McClure's, a step that makes
the sum of w (r + j . step)^2 least over the views solves (sum of w j j^T) step = -(sum of w r j).
"""

from dataclasses import dataclass, replace

import numpy as np

from taichi_edges.arrays.columns import Columns

# The numbers that kernels add up for a point: upper triangle of the matrix, gradient, weight, views.
GRADIENT, WEIGHT, VIEWS = 6, 9, 10  # where they begin
NUMBERS = 11


@dataclass(frozen=True)
class PlaneEquations(Columns):
    """Of n points, float64.

    matrices: (n, 3, 3) sums of w j j^T. gradients: (n, 3) sums of w r j. weights: (n,) sums of w. views: (n,) number of
    views that have the point in the image; 0 where that was not asked.
    """

    matrices: np.ndarray
    gradients: np.ndarray
    weights: np.ndarray
    views: np.ndarray

    @staticmethod
    def of(numbers: np.ndarray) -> "PlaneEquations":
        """From what kernels added up, (n, NUMBERS) float32."""
        numbers = numbers.astype(np.float64)
        matrices, (rows, columns) = np.empty((len(numbers), 3, 3)), np.triu_indices(3)
        matrices[:, rows, columns] = matrices[:, columns, rows] = numbers[:, :GRADIENT]
        return PlaneEquations(matrices, numbers[:, GRADIENT:WEIGHT], numbers[:, WEIGHT], numbers[:, VIEWS])

    def weighed(self, factors: np.ndarray) -> "PlaneEquations":
        """The same, every point's by (n,) factors the surer."""
        matrices, gradients = factors[:, None, None] * self.matrices, factors[:, None] * self.gradients
        return replace(self, matrices=matrices, gradients=gradients, weights=factors * self.weights)
