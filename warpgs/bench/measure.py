"""Measurements of rendering one random scene: times, memory, kernels, and differences from another renderer."""

import dataclasses
import statistics
from collections import defaultdict
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.ops.projection import Geometry, View, project_fwd
from warpgs.ops.ssim import ssim
from warpgs.ops.tiles import bin_splats
from warpgs.runtime.graphs import capture
from warpgs.runtime.profiling import KernelTime, profile

from .options import Bench
from .scenes import SEED, Scene
from .timing import milliseconds
from .workloads import OTHERS, Workload, graphed, make_workload, parameter_names

WARM_UPS = {"cuda": 50, "cpu": 1}
"""Runs before the first measured one. On CUDA they bring clock rates and threads to a steady state; on CPU, where runs
take long, one run compiles the kernels."""

VISIBLE_DIFFERENCE = 1e-3
"""A pixel that differs by more than this in any channel counts as visibly different."""

STAGES = {
    "project_fwd": ("sh_fwd", "project_fwd"),
    "bin": ("count_tiles", "emit_isects", "tile_ranges", "split_tiles"),
    "sort": ("sort_pairs",),
    "composite_fwd": ("composite_fwd",),
    "composite_bwd": ("composite_bwd",),
    "project_bwd": ("project_bwd", "sh_bwd"),
    "ssim": ("ssim_fwd", "ssim_bwd"),
}
"""Kernels of each stage of a render."""

STAGE_OF_KERNEL = {kernel: stage for stage, kernels in STAGES.items() for kernel in kernels}

Measurements = dict[str, Any]
"""Measured values by name; nested for stages and comparisons."""


def measure(options: Bench, scene: Scene, device: str) -> tuple[Measurements, list[KernelTime]]:
    """All measurements of a scene, and the kernels of one forward and backward pass."""
    splats, camera = scene.make(options.branches, device, options.sh_degree)
    for name in parameter_names(splats):
        getattr(splats, name).requires_grad_()
    settings = RenderSettings(depth=options.depth)
    one = make_workload(splats, camera, settings)
    workloads = {"one_image": one}
    if options.branches != "none":
        branched = dataclasses.replace(settings, branches=True)
        workloads["three_images"] = make_workload(splats, camera, branched)
    own = list(workloads)
    if options.against:
        workloads[options.against] = OTHERS[options.against](one, camera, options.depth)
    measured = {name: peak_memory(workload) for name, workload in workloads.items()}
    for (name, metric), median in time_passes(workloads, own if options.graph else [], device, options.repeats).items():
        measured[name][metric] = median
    for name in own:
        measured[name]["stages_ms"] = time_stages(workloads[name], device, options.repeats)
    result = {
        **dataclasses.asdict(scene),
        "sh_degree": options.sh_degree,
        "intersections": count_intersections(splats, camera, settings),
        **measured,
        "ratios_to_one_image": {n: ratios(measured[n], measured["one_image"]) for n in measured if n != "one_image"},
    }
    if options.against:
        result[f"differences_from_{options.against}"] = differences(one, workloads[options.against])
    with profile() as kernels:
        workloads[own[-1]].forward_backward()
    return result, kernels.times()


def time_passes(
    workloads: dict[str, Workload], graphs: list[str], device: str, repeats: int
) -> dict[tuple[str, str], float]:
    """Median times [ms] by workload and metric, measured one metric after the other; ``graphs`` also as CUDA graphs."""
    passes = {"forward_ms": Workload.forward, "forward_backward_ms": Workload.forward_backward}
    if device == "cuda":
        passes["one_thread_forward_backward_ms"] = Workload.forward_backward_on_one_thread
    times = {
        metric: time_in_turn({name: partial(run, workload) for name, workload in workloads.items()}, device, repeats)
        for metric, run in passes.items()
    }
    if graphs:  # last: beside a graphed callable, torch warns that plain calls may synchronise without need
        callables = {name: graphed(workloads[name]).forward_backward for name in graphs}
        times["callable_forward_backward_ms"] = time_in_turn(callables, device, repeats)
        captured = {name: capture(workloads[name].forward_backward) for name in graphs}
        times["graph_forward_backward_ms"] = time_in_turn(captured, device, repeats)
    return {(name, metric): ms for metric, medians in times.items() for name, ms in medians.items()}


def time_in_turn(steps: Mapping[str, Callable[[], object]], device: str, repeats: int) -> dict[str, float]:
    """Median times [ms] of alternating steps, so that clock rates and sleeping threads affect all of them equally."""
    for _ in range(WARM_UPS[device]):
        for step in steps.values():
            step()
    samples: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(repeats):
        for name, step in steps.items():
            samples[name].append(milliseconds(step, device))
    return {name: statistics.median(values) for name, values in samples.items()}


def time_stages(workload: Workload, device: str, repeats: int) -> dict[str, float]:
    """Median time [ms] of the kernels of each stage, and of SSIM between the rendered image and noise."""
    image = workload.forward()[0].contiguous().requires_grad_()
    noise = torch.rand(image.shape, dtype=torch.float32, generator=torch.Generator().manual_seed(SEED)).to(image.device)
    samples: list[dict[str, float]] = []
    for _ in range(WARM_UPS[device] + repeats):
        with profile() as kernels:
            workload.forward_backward()
            torch.autograd.grad(ssim(image, noise), image)
        sums: dict[str, float] = defaultdict(float)
        for kernel in kernels.times():
            sums[STAGE_OF_KERNEL.get(kernel.name, kernel.name)] += kernel.duration_ms
        samples.append(sums)
    samples = samples[WARM_UPS[device] :]
    stages = [*STAGES, *(stage for stage in samples[0] if stage not in STAGES)]
    return {stage: statistics.median(sample[stage] for sample in samples) for stage in stages}


def peak_memory(workload: Workload) -> Measurements:
    """Maximum memory allocated by torch during a forward and backward pass [bytes]; empty on CPU."""
    workload.forward_backward()
    if not workload.parameters[0].is_cuda:
        return {}
    torch.cuda.reset_peak_memory_stats()
    workload.forward_backward()
    torch.cuda.synchronize()
    return {"peak_memory_bytes": torch.cuda.max_memory_allocated()}


@torch.no_grad()
def count_intersections(splats: Splats, camera: Camera, settings: RenderSettings) -> int:
    """Number of pairs of a Gaussian and a tile that it intersects."""
    geometry = Geometry(splats.means, splats.quats, splats.scales, splats.opacities)
    view = View(camera.viewmat, camera.K, *camera.size)
    features = splats.means  # any will do
    rows, _, order = project_fwd(geometry, features, view, settings.near, settings.antialias, with_depth=False)
    begins, ends = bin_splats(rows, order, camera.size).ranges.unbind(-1)
    return int((ends - begins).sum())


def ratios(measured: Measurements, base: Measurements) -> Measurements:
    """Times relative to those of ``base``; without a graph, plain calls are compared with the graph of ``base``."""
    passes = ("forward", "forward_backward", "one_thread_forward_backward")
    result = {f: measured[f"{f}_ms"] / base[f"{f}_ms"] for f in passes if f"{f}_ms" in base}
    for graph in ("callable_forward_backward", "graph_forward_backward"):
        if f"{graph}_ms" in base:
            result[graph] = measured.get(f"{graph}_ms", measured["forward_backward_ms"]) / base[f"{graph}_ms"]
    return result


def differences(ours: Workload, theirs: Workload) -> Measurements:
    """Absolute differences of the images, and norms of the differences of gradients relative to the norms of theirs."""
    difference = (ours.forward()[0] - theirs.forward()[0]).abs()
    gradients = zip(ours.forward_backward(), theirs.forward_backward(), strict=True)
    relative = [float((a - b).norm() / b.norm()) for a, b in gradients]
    return {
        "max_image": float(difference.max()),
        "mean_image": float(difference.mean()),
        "visible_pixels": int((difference.amax(-1) > VISIBLE_DIFFERENCE).sum()),
        "relative_gradients": dict(zip(ours.names, relative, strict=True)),
    }
