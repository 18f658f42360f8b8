"""Measurements of one random scene: times, memory, kernels, and differences from another renderer."""

import dataclasses
import statistics
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.ops.projection import Geometry, View, record_projection
from warpgs.ops.rows import Rows
from warpgs.ops.ssim import ssim
from warpgs.ops.tiles import record_tiles
from warpgs.runtime.graphs import capture
from warpgs.runtime.profiling import KernelTime, profile
from warpgs.runtime.replay import EAGER_CALLS
from warpgs.runtime.tape import OpContext

from .command import Bench
from .scenes import SEED, Scene
from .timing import milliseconds
from .workloads import PARAMETERS, Workload, make_gsplat_workload, make_workload

WARM_UPS = {"cuda": 50 + EAGER_CALLS, "cpu": 1}
"""Runs before the first that counts, until replays are recorded and clocks and threads are as in the long run; on CPU
only compilation is to be kept out, and runs are long."""

VISIBLE_DIFFERENCE = 1e-3
"""Pixels that differ by more than this in any channel are counted."""

STAGES = {
    "project": ("project_fwd", "sh_fwd", "pack", "pack_features"),
    "bin": ("count_tiles", "emit_isects", "tile_ranges", "split_tiles"),
    "sort": ("sort_pairs",),
    "composite_fwd": ("composite_fwd",),
    "composite_bwd": ("composite_bwd",),
    "unproject": ("unpack", "sh_bwd", "project_bwd"),
    "ssim": ("ssim_fwd", "ssim_bwd"),
}
STAGE_OF_KERNEL = {kernel: stage for stage, kernels in STAGES.items() for kernel in kernels}

Measurements = dict[str, Any]


def measure(options: Bench, scene: Scene, device: str) -> tuple[Measurements, list[KernelTime]]:
    """All figures of a scene (see ``bench_report``), and the kernels of one render and its way back."""
    splats, camera = scene.make(options.branches, device)
    for name in PARAMETERS:
        getattr(splats, name).requires_grad_()
    settings = RenderSettings(depth=options.depth)
    one = make_workload(splats, camera, settings)
    workloads = {"one_image": one}
    if options.branches != "none":
        branched = dataclasses.replace(settings, branches=True)
        workloads["three_images"] = make_workload(splats, camera, branched)
    own = list(workloads)
    if options.against == "gsplat":
        workloads["gsplat"] = make_gsplat_workload(one, camera, options.depth)
    figures = {name: peak_memory(workload) for name, workload in workloads.items()}
    for (name, figure), median in time_passes(workloads, own if options.graph else [], device, options.repeats).items():
        figures[name][figure] = median
    for name in own:
        figures[name]["stages_ms"] = time_stages(workloads[name], device, options.repeats)
    result = {
        **dataclasses.asdict(scene),
        "intersections": count_intersections(splats, camera, settings),
        **figures,
        "ratios_to_one_image": {n: ratios(figures[n], figures["one_image"]) for n in figures if n != "one_image"},
    }
    if "gsplat" in workloads:
        result["differences_from_gsplat"] = differences(one, workloads["gsplat"])
    with profile() as taken:
        workloads[own[-1]].forward_backward()
    return result, taken.times()


def time_passes(
    workloads: dict[str, Workload], graphed: list[str], device: str, repeats: int
) -> dict[tuple[str, str], float]:
    """Median times [ms] by workload and figure; each figure has a loop of its own."""
    passes = {"forward_ms": Workload.forward, "forward_backward_ms": Workload.forward_backward}
    if device == "cuda":
        passes["one_thread_forward_backward_ms"] = Workload.forward_backward_on_one_thread
    figures: dict[str, dict[str, Callable[[], object]]] = {
        figure: {name: partial(go, workload) for name, workload in workloads.items()} for figure, go in passes.items()
    }
    figures["graph_forward_backward_ms"] = {name: capture(workloads[name].forward_backward) for name in graphed}
    return {
        (n, figure): ms for figure, steps in figures.items() for n, ms in time_in_turn(steps, device, repeats).items()
    }


def time_in_turn(steps: dict[str, Callable[[], object]], device: str, repeats: int) -> dict[str, float]:
    """Median times [ms] of steps that take turns, so that all see the same clock rates, and threads as awake."""
    for _ in range(WARM_UPS[device]):
        for step in steps.values():
            step()
    samples: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(repeats):
        for name, step in steps.items():
            samples[name].append(milliseconds(step, device))
    return {name: statistics.median(values) for name, values in samples.items()}


def time_stages(workload: Workload, device: str, repeats: int) -> dict[str, float]:
    """Median time [ms] of each stage's kernels, with SSIM of the rendered image and of noise."""
    image = workload.forward()[0].contiguous().requires_grad_()
    noise = torch.rand(image.shape, generator=torch.Generator().manual_seed(SEED)).to(image.device)
    samples: list[dict[str, float]] = []
    for _ in range(WARM_UPS[device] + repeats):
        with profile() as taken:
            workload.forward_backward()
            torch.autograd.grad(ssim(image, noise), image)
        sums: dict[str, float] = defaultdict(float)
        for kernel in taken.times():
            sums[STAGE_OF_KERNEL.get(kernel.name, kernel.name)] += kernel.duration_ms
        samples.append(sums)
    samples = samples[WARM_UPS[device] :]
    stages = [*STAGES, *(stage for stage in samples[0] if stage not in STAGES)]
    return {stage: statistics.median(sample[stage] for sample in samples) for stage in stages}


def peak_memory(workload: Workload) -> Measurements:
    """The most that torch had allocated [bytes] during a render and its way back; nothing on CPU."""
    workload.forward_backward()
    if not workload.parameters[0].is_cuda:
        return {}
    torch.cuda.reset_peak_memory_stats()
    workload.forward_backward()
    torch.cuda.synchronize()
    return {"peak_memory_bytes": torch.cuda.max_memory_allocated()}


@torch.no_grad()
def count_intersections(splats: Splats, camera: Camera, settings: RenderSettings) -> int:
    """Pairs of a Gaussian and a tile that it touches."""
    ctx = OpContext(splats.means.device, [])
    geometry = Geometry(splats.means, splats.quats, splats.scales, splats.opacities)
    view = View(camera.viewmat, camera.K, *camera.size)
    projection = record_projection(ctx, geometry, view, settings.near, settings.antialias)
    rows = Rows(ctx, projection, splats.num_channels, settings.depth, camera.size)
    begins, ends = record_tiles(ctx, rows, camera.size).ranges.unbind(-1)
    return int((ends - begins).sum())


def ratios(figures: Measurements, base: Measurements) -> Measurements:
    """Times over those of ``base``; without a graph of its own, also over the base's graph."""
    passes = ("forward", "forward_backward", "one_thread_forward_backward")
    result = {f: figures[f"{f}_ms"] / base[f"{f}_ms"] for f in passes if f"{f}_ms" in base}
    graph = "graph_forward_backward_ms"
    if graph in base:
        result["graph_forward_backward"] = figures.get(graph, figures["forward_backward_ms"]) / base[graph]
    return result


def differences(ours: Workload, theirs: Workload) -> Measurements:
    """Absolute differences of images, and of gradients relative to the length of theirs."""
    difference = (ours.forward()[0] - theirs.forward()[0]).abs()
    gradients = zip(ours.forward_backward(), theirs.forward_backward(), strict=True)
    relative = [float((a - b).norm() / b.norm()) for a, b in gradients]
    return {
        "max_image": float(difference.max()),
        "mean_image": float(difference.mean()),
        "visible_pixels": int((difference.amax(-1) > VISIBLE_DIFFERENCE).sum()),
        "relative_gradients": dict(zip(PARAMETERS, relative, strict=True)),
    }
