"""Training: the paper's schedule (3.1, 3.2 and supplement) over the view steps of a scene."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from taichi_edges.errors import UserError
from taichi_edges.evidence.support import exclusive_support
from taichi_edges.splatting import density
from taichi_edges.splatting.density import Population
from taichi_edges.splatting.gaussians import Gaussians, logit
from taichi_edges.splatting.splatter import GPU_ARCHS, Splatter

if TYPE_CHECKING:
    from taichi_edges.progress import Progress
    from taichi_edges.scene.settings import TrainConfig
    from taichi_edges.views.views import Views

Action = Callable[[Population], Population]  # of density control

SETTLED_PASSES = 2  # over the views; the pixels drawn anew make the loss of a single pass uncertain by 0.7 %
ESTABLISHED_OPACITY = 0.2  # fainter ones are in no result: the least of the filters
LOG_STEPS = 50  # view steps between two lines of the training log


@dataclass(frozen=True)
class LogRecord:
    """One line of the training log. seconds: since the start. loss: mean of L_proj over the steps since the last."""

    step: int
    seconds: float
    loss: float
    gaussians: int


def rates(config: "TrainConfig", share: float) -> tuple[float, float, float, float]:
    """Learning rates (means, scales, quaternions, opacities) after a share of the run (supplement, "Training")."""
    decays = min(int(share / config.means_decay_every + 1e-9), config.means_decays)
    means = config.learning_rates.means * config.means_decay**decays
    if share < config.only_means:
        return means, 0.0, 0.0, 0.0
    others = config.learning_rates
    return means, others.scales, others.quaternions, others.opacities


def nearest_neighbors(points: np.ndarray, k: int) -> np.ndarray:
    """(n, 3) -> (n, k) indices of the k nearest other points, from Open3D's KD-tree; the last repeats where n <= k."""
    import open3d as o3d

    tensor = o3d.core.Tensor(np.ascontiguousarray(points, dtype=np.float64))
    search = o3d.core.nns.NearestNeighborSearch(tensor)
    search.knn_index()
    indices, _ = search.knn_search(tensor, min(k + 1, len(points)))
    indices = indices.numpy().astype(np.int64)
    own = np.arange(len(points))[:, None]
    # A point is its own nearest, but among coinciding points it need not come first: drop it wherever it stands.
    order = np.argsort(indices == own, axis=1, kind="stable")
    others = np.take_along_axis(indices, order, axis=1)[:, : min(k, max(len(points) - 1, 1))]
    return others if others.shape[1] == k else np.pad(others, ((0, 0), (0, k - others.shape[1])), mode="edge")


class Settling:
    """How much the loss still falls: what each view has now against what it had one pass before."""

    def __init__(self, views: np.ndarray) -> None:
        """views: (n,) indices of those that are visited."""
        self.last: dict[int, float] = {}
        self.steps = SETTLED_PASSES * len(views)
        self.before: deque[float] = deque(maxlen=self.steps)
        self.now: deque[float] = deque(maxlen=self.steps)

    def add(self, view: int, loss: float) -> None:
        """The loss that a view has now."""
        if view in self.last:
            self.before.append(self.last[view])
            self.now.append(loss)
        self.last[view] = loss

    def drop(self) -> float:
        """Share by which a pass has lowered the loss, over the last SETTLED_PASSES; infinite before there are any."""
        if len(self.now) < self.steps:
            return np.inf
        return 1.0 - sum(self.now) / sum(self.before)


class Training:
    """The state of one training run. `config` is the scene's `train` section."""

    def __init__(
        self, views: "Views", config: "TrainConfig", generator: np.random.Generator, threads: int = 1, arch: str = "cpu"
    ) -> None:
        self.views, self.config, self.generator = views, config, generator
        self.neighbors_at: int | None = None
        self.splatter = Splatter(
            views.edge_maps,
            views.intrinsics,
            views.world_to_camera,
            capacity=config.gaussians,
            edge_threshold=config.edge_threshold,
            loss=config.loss,
            neighbors=config.neighbors,
            threads=threads,
            schedule="log" if arch in GPU_ARCHS else "product",
            edgels=views.edgels,
            strength_weight=config.strength_weight,
            flanks=config.takes_in_flanks,
        )
        self.visited = self._views_with_pixels()
        # A length in steps is enough for a few hundred views; of more, every one is seen once.
        self.total = max(config.steps, len(self.visited)) if config.steps else config.epochs * len(self.visited)
        self.settling = Settling(self.visited)
        self.actions = self._actions()

    def run(self, gaussians: Gaussians, progress: "Progress") -> tuple[Gaussians, list[LogRecord]]:
        """Train `gaussians`. Returns the trained ones and the list of LogRecords."""
        self.splatter.load(gaussians)
        records, losses, started = [], [], time.monotonic()
        with progress.track("train", self.total) as report:
            for step, (page, view) in zip(range(1, self.total + 1), self._selected_views(), strict=False):
                loss = self._step(step, page)
                if loss is not None:
                    losses.append(loss)
                    self.settling.add(view, loss)
                self._control_density(step)
                settled = self._has_settled(step)
                if step % LOG_STEPS == 0 or step == self.total or settled:
                    count, mean = self.splatter.fields.count, float(np.mean(losses)) if losses else float("nan")
                    records.append(LogRecord(step, time.monotonic() - started, mean, count))
                    report(step, f"loss {mean:.4f}, {count} Gaussians")
                    losses = []
                if settled:
                    break
        return self.splatter.fields.gaussians(), records

    def _has_settled(self, step: int) -> bool:
        """Whether the run may end here: all that is scheduled has begun, and the loss hardly falls."""
        config = self.config
        begun = max(config.only_means, config.regularize_from) * self.total
        return step >= max(begun, *self.actions, 1) and 0 < config.settled >= self.settling.drop()

    def _views_with_pixels(self) -> np.ndarray:
        """Indices of the views in which pixels can be selected: for eq. 3 those with edge pixels."""
        if self.config.loss != "balanced":
            return np.arange(len(self.views))
        visited = np.flatnonzero(self.splatter.images.edge_counts)
        if len(visited) == 0:
            raise UserError(
                f"none of the {len(self.views)} edge maps has an edge pixel after thinning; lower train.edge_threshold "
                "or source.thin_threshold, or set source.thin: false"
            )
        return visited

    def _selected_views(self) -> Iterator[tuple[int, int]]:
        """(page, view) without end: pass after pass in random order, their pixels selected some views at a time."""
        pages = self.splatter.selection.pages
        while True:
            order = self.generator.permutation(self.visited)
            seeds = self.generator.integers(1 << 32, size=len(order))
            for first in range(0, len(order), pages):
                some = slice(first, first + pages)
                self.splatter.select_pixels(order[some], seeds[some])
                yield from enumerate(order[some])

    def _step(self, step: int, page: int) -> float | None:
        """One view step. Returns L_proj, or None where the regularisers are in the loss."""
        share = (step - 1) / self.total
        weights = self._regularizer_weights(step, share)
        self.splatter.record(page, *weights)
        loss = None if any(weights) else float(self.splatter.loss[None])
        self.splatter.update(step, *rates(self.config, share))
        return loss

    def _regularizer_weights(self, step: int, share: float) -> tuple[float, float]:
        """lambda_1 and lambda_2 of eq. 6 in the steps that apply them, (0, 0) in the others."""
        config, count = self.config, self.splatter.fields.count
        if share < config.regularize_from or step % config.regularize_every or count <= config.neighbors:
            return 0.0, 0.0
        if self.neighbors_at is None or step - self.neighbors_at >= config.neighbors_refresh_steps:
            self.splatter.neighbors.load(nearest_neighbors(self.splatter.fields.gaussians().means, config.neighbors))
            self.neighbors_at = step
        return config.orient_weight, config.shape_weight

    def _actions(self) -> dict[int, list[Action]]:
        """Step -> what density control does after it."""
        config = self.config.density
        actions: dict[int, list[Action]] = {}
        for shares, action in (
            (config.duplicate_at, self._duplicate),
            (config.cull_support_at, self._cull_support),
            (config.cull_opacity_at, self._cull_opacity),
        ):
            for step in sorted({max(round(share * self.total), 1) for share in shares}):
                actions.setdefault(step, []).append(action)
        if self.config.takes_in_flanks:
            first = max(round(self.config.flanks_from * self.total), 1)
            culls = {max(round(share * self.total), 1) for share in config.cull_support_at}
            for step in sorted({first, *(step for step in culls if step > first)}):
                actions.setdefault(step, []).append(self.take_in_flanks)
        return actions

    def _control_density(self, step: int) -> None:
        """Culling and duplication where the schedule asks for it after this step."""
        if step not in self.actions:
            return
        fields = self.splatter.fields
        gradients = fields.positional_gradients.to_numpy()[: fields.count]
        population = Population(fields.gaussians(), *fields.moments(), gradients)
        for action in self.actions[step]:
            population = action(population)
        if len(population) == 0:
            raise UserError(
                f"view step {step}: no Gaussian is left after culling; the edge maps do not agree with the cameras "
                "(check source.axes and the intrinsics), or train.density culls too much"
            )
        self.splatter.load(population.gaussians, (population.first_moments, population.second_moments))
        self.neighbors_at = None
        self.settling = Settling(self.visited)  # a cull makes the loss jump

    def _duplicate(self, population: Population) -> Population:
        config = self.config.density
        maximum, distance = config.max_gaussians, config.duplicate_distance
        share, copies = config.duplicate_gradient, config.duplicate_copies
        return density.duplicate(population, share, copies, distance, maximum, self.generator)

    def _cull_support(self, population: Population) -> Population:
        config, threshold = self.config.density, self.config.edge_threshold
        population = density.cull_support(population, self.views, config.min_support, threshold)
        return self._limit_opacity(population)

    def _cull_opacity(self, population: Population) -> Population:
        return self._limit_opacity(density.cull_opacity(population, self.config.density.min_opacity))

    def take_in_flanks(self, population: Population) -> Population:
        """The mask with the flanks of the lines, except where an edge that other views have established is hidden."""
        config, gaussians = self.config, population.gaussians
        points = np.zeros((0, 3))
        if config.established_support > 0:
            points = gaussians.means[gaussians.opacities >= ESTABLISHED_OPACITY].astype(np.float64)
            points = points[exclusive_support(self.views, points, config.edge_threshold) >= config.established_support]
        self.splatter.take_in_flanks(points)
        return population

    def _limit_opacity(self, population: Population) -> Population:
        """Opacities down to the initial one after a cull, so that the survivors must earn theirs again (as in 3DGS)."""
        if not self.config.density.reset_opacity:
            return population
        gaussians = population.gaussians
        limited = np.minimum(gaussians.opacity_logits, np.float32(logit(self.config.initial_opacity)))
        reset = Gaussians(gaussians.means, gaussians.log_scales, gaussians.quaternions, limited)
        return Population(reset, population.first_moments, population.second_moments, population.positional_gradients)
