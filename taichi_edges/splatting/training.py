"""Training: the paper's schedule (3.1, 3.2 and supplement) over the view steps of a scene."""

import gc
import time
from dataclasses import dataclass

import numpy as np
import taichi as ti

from taichi_edges.errors import UserError
from taichi_edges.splatting import density
from taichi_edges.splatting.density import Population
from taichi_edges.splatting.gaussians import Gaussians, logit
from taichi_edges.splatting.splatter import GPU_ARCHS, Splatter


@dataclass(frozen=True)
class EpochRecord:
    """One line of the training log. seconds: since the start. loss: mean of L_proj over the epoch's views."""

    epoch: int
    seconds: float
    loss: float
    gaussians: int


def start_taichi(arch, threads, seed, cache):
    """ti.init for this project: f32, quiet, kernels cached in the folder `cache`.

    arch: 'cpu', 'cuda' or 'vulkan'. UserError where the machine does not have it.
    """
    gc.collect()  # an ndarray of an earlier program that is freed later would take memory of the new one with it
    available = {"cpu": ti.cpu, "cuda": ti.cuda, "vulkan": ti.vulkan}
    ti.init(
        arch=available[arch],
        default_fp=ti.f32,
        cpu_max_num_threads=threads,
        random_seed=seed,
        offline_cache=True,
        offline_cache_file_path=str(cache),
        log_level=ti.ERROR,
    )
    in_use = ti.lang.impl.current_cfg().arch
    if arch != "cpu" and in_use != available[arch]:
        raise UserError(f"--arch {arch}: this machine offers Taichi no {arch} device; use --arch cpu")


def rates(config, epoch):
    """Learning rates (means, scales, quaternions, opacities) of an epoch counted from 0 (supplement, "Training")."""
    decays = min(epoch // config.means_decay_epochs, config.means_decays)
    means = config.learning_rates.means * config.means_decay**decays
    if epoch < config.only_means_epochs:
        return means, 0.0, 0.0, 0.0
    others = config.learning_rates
    return means, others.scales, others.quaternions, others.opacities


def nearest_neighbors(points, k):
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


class Training:
    """The state of one training run. `config` is the scene's `train` section."""

    def __init__(self, views, config, generator, threads=1, arch="cpu"):
        self.views, self.config, self.generator = views, config, generator
        self.step = 0
        self.neighbors_at = None
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
        )

    def run(self, gaussians, progress):
        """Train `gaussians`. Returns the trained ones and the list of EpochRecords."""
        self.splatter.load(gaussians)
        records, started = [], time.monotonic()
        with progress.track("train", self.config.epochs) as report:
            for epoch in range(self.config.epochs):
                loss = self._epoch(epoch)
                self._control_density(epoch)
                count = self.splatter.fields.count
                records.append(EpochRecord(epoch + 1, time.monotonic() - started, loss, count))
                report(epoch + 1, f"loss {loss:.4f}, {count} Gaussians")
        return self.splatter.fields.gaussians(), records

    def _epoch(self, epoch):
        """One pass over the views in random order. Returns the mean loss."""
        losses = []
        learning_rates = rates(self.config, epoch)
        for view in self.generator.permutation(len(self.views)):
            seed = int(self.generator.integers(1 << 32))
            if not self.splatter.select_pixels(int(view), seed):
                continue
            weights = self._regularizer_weights(epoch)
            self.splatter.record(int(view), *weights)
            if not any(weights):
                losses.append(self.splatter.loss[None])
            self.step += 1
            self.splatter.update(self.step, *learning_rates)
        return float(np.mean(losses)) if losses else float("nan")

    def _regularizer_weights(self, epoch):
        """lambda_1 and lambda_2 of eq. 6 in the steps that apply them, (0, 0) in the others."""
        config, count = self.config, self.splatter.fields.count
        if epoch < config.regularize_from_epoch or self.step % config.regularize_every or count <= config.neighbors:
            return 0.0, 0.0
        stale = self.neighbors_at is None or self.step - self.neighbors_at >= config.neighbors_refresh_steps
        if stale:
            self.splatter.neighbors.load(nearest_neighbors(self.splatter.fields.gaussians().means, config.neighbors))
            self.neighbors_at = self.step
        return config.orient_weight, config.shape_weight

    def _control_density(self, epoch):
        """Culling and duplication where the schedule asks for it after this epoch (counted from 1 in the schedule)."""
        config, done = self.config.density, epoch + 1
        actions = []
        if done in config.duplicate_epochs:
            actions.append(self._duplicate)
        if done in config.cull_support_epochs:
            actions.append(self._cull_support)
        if done in config.cull_opacity_epochs:
            actions.append(self._cull_opacity)
        if not actions:
            return
        fields = self.splatter.fields
        gradients = fields.positional_gradients.to_numpy()[: fields.count]
        population = Population(fields.gaussians(), *fields.moments(), gradients)
        for action in actions:
            population = action(population)
        if len(population) == 0:
            raise UserError(
                f"epoch {done}: no Gaussian is left after culling; the edge maps do not agree with the cameras "
                "(check source.axes and the intrinsics), or train.density culls too much"
            )
        self.splatter.load(population.gaussians, (population.first_moments, population.second_moments))
        self.neighbors_at = None

    def _duplicate(self, population):
        config = self.config.density
        maximum, distance = config.max_gaussians, config.duplicate_distance
        share, copies = config.duplicate_gradient, config.duplicate_copies
        return density.duplicate(population, share, copies, distance, maximum, self.generator)

    def _cull_support(self, population):
        config, threshold = self.config.density, self.config.edge_threshold
        population = density.cull_support(population, self.views, config.min_support, threshold)
        return self._limit_opacity(population)

    def _cull_opacity(self, population):
        return self._limit_opacity(density.cull_opacity(population, self.config.density.min_opacity))

    def _limit_opacity(self, population):
        """Opacities down to the initial one after a cull, so that the survivors must earn theirs again (as in 3DGS)."""
        if not self.config.density.reset_opacity:
            return population
        gaussians = population.gaussians
        limited = np.minimum(gaussians.opacity_logits, np.float32(logit(self.config.initial_opacity)))
        reset = Gaussians(gaussians.means, gaussians.log_scales, gaussians.quaternions, limited)
        return Population(reset, population.first_moments, population.second_moments, population.positional_gradients)
