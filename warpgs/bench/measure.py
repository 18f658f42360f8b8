"""Measurements of rendering one scene: times, memory, kernels, and differences from another renderer."""

import dataclasses
import statistics
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Int32
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.ops.projection import Geometry, View, project_fwd
from warpgs.ops.ssim import ssim
from warpgs.ops.tiles import bin_splats
from warpgs.runtime.graphs import capture
from warpgs.runtime.profiling import KernelTime, profile

from .options import Bench
from .scenes import SEED, Views
from .timing import milliseconds
from .workloads import OTHERS, Workload, graphed, make_workload, parameter_names, sh_degree_of

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
    "ssim": ("ssim_fwd", "ssim_bwd", "ssim_cpu_fwd", "ssim_cpu_bwd"),
}
"""Kernels of each stage of a render."""

STAGE_OF_KERNEL = {kernel: stage for stage, kernels in STAGES.items() for kernel in kernels}

Measurements = dict[str, Any]
"""Measured values by name; nested for stages and comparisons."""


def measure(options: Bench, views: Views, device: str) -> tuple[Measurements, list[KernelTime]]:
    """All measurements of a scene, and the kernels of one forward and backward pass through its last camera."""
    settings = RenderSettings(depth=options.depth, antialias=views.antialias)
    workloads = make_workloads(options, views, settings)
    own = [name for name in workloads if name != options.against]
    measured = {name: peak_memory(of_views) for name, of_views in workloads.items()}
    for (name, metric), median in time_passes(workloads, own if options.graph else [], device, options.repeats).items():
        measured[name][metric] = median
    for name in own:
        measured[name]["stages_ms"] = time_stages(workloads[name], device, options.repeats)
    lengths = [tile_lengths(*view, settings) for view in zip(views.splats, views.cameras, strict=True)]
    width, height = views.cameras[0].size
    result = {
        "name": views.name,
        "width": width,
        "height": height,
        "num_gaussians": len(views.splats[0].means),
        "cameras": len(views.cameras),
        "sh_degree": sh_degree_of(workloads["one_image"][0]),
        "intersections": statistics.median_low(int(of_view.sum()) for of_view in lengths),
        "intersections_per_tile": tail(torch.cat(lengths)),
        **measured,
        "ratios_to_one_image": {n: ratios(measured[n], measured["one_image"]) for n in measured if n != "one_image"},
    }
    if options.against:
        pairs = zip(workloads["one_image"], workloads[options.against], strict=True)
        result[f"differences_from_{options.against}"] = worst([differences(*pair) for pair in pairs])
    with profile() as kernels:
        workloads[own[-1]][-1].forward_backward()
    return result, kernels.times()


def make_workloads(options: Bench, views: Views, settings: RenderSettings) -> dict[str, list[Workload]]:
    """The workloads to compare by name, one for each camera."""
    workloads: dict[str, list[Workload]] = defaultdict(list)
    for splats, camera in zip(views.splats, views.cameras, strict=True):
        for name in parameter_names(splats):
            getattr(splats, name).requires_grad_()
        one = make_workload(splats, camera, settings)
        workloads["one_image"].append(one)
        if options.branches != "none":
            branched = dataclasses.replace(settings, branches=True)
            workloads["three_images"].append(make_workload(splats, camera, branched))
        if options.against:
            workloads[options.against].append(OTHERS[options.against](one, camera, settings))
    return workloads


def time_passes(
    workloads: Mapping[str, list[Workload]], graphs: list[str], device: str, repeats: int
) -> dict[tuple[str, str], float]:
    """Median times [ms] by workload and metric, measured one metric after the other; ``graphs`` also as CUDA graphs."""
    passes = {"forward_ms": Workload.forward, "forward_backward_ms": Workload.forward_backward}
    if device == "cuda":
        passes["one_thread_forward_backward_ms"] = Workload.forward_backward_on_one_thread
    times = {
        metric: time_in_turn(
            {name: [partial(run, workload) for workload in of_views] for name, of_views in workloads.items()},
            device,
            repeats,
        )
        for metric, run in passes.items()
    }
    if graphs:  # last: beside a graphed callable, torch warns that plain calls may synchronise without need
        callables = {name: [graphed(workload).forward_backward for workload in workloads[name]] for name in graphs}
        times["callable_forward_backward_ms"] = time_in_turn(callables, device, repeats)
        for metric, run in (("forward_ms", Workload.forward), ("forward_backward_ms", Workload.forward_backward)):
            captured = {name: [capture(partial(run, workload)) for workload in workloads[name]] for name in graphs}
            times[f"graph_{metric}"] = time_in_turn(captured, device, repeats)
    return {(name, metric): ms for metric, medians in times.items() for name, ms in medians.items()}


def time_in_turn(steps: Mapping[str, Sequence[Callable[[], object]]], device: str, repeats: int) -> dict[str, float]:
    """Median times [ms] of alternating steps, so that clock rates and sleeping threads affect all of them equally.

    Each name has a step for every camera; its time is the median of their medians.
    """
    turns = [
        (name, k, step)
        for k, of_camera in enumerate(zip(*steps.values(), strict=True))
        for name, step in zip(steps, of_camera, strict=True)
    ]
    for _ in range(warm_ups(device, len(turns) // len(steps))):
        for _, _, step in turns:
            step()
    samples: dict[str, dict[int, list[float]]] = {name: defaultdict(list) for name in steps}
    for _ in range(repeats):
        for name, k, step in turns:
            samples[name][k].append(milliseconds(step, device))
    return {name: statistics.median(map(statistics.median, of_name.values())) for name, of_name in samples.items()}


def warm_ups(device: str, cameras: int) -> int:
    """Runs through each of several cameras before the first measured one."""
    return -(-WARM_UPS[device] // cameras)


def time_stages(workloads: list[Workload], device: str, repeats: int) -> dict[str, float]:
    """Times [ms] of the kernels of each stage, as the median over cameras of their medians."""
    discarded = warm_ups(device, len(workloads))
    of_cameras = [time_stages_of(workload, discarded, repeats) for workload in workloads]
    return {stage: statistics.median(times[stage] for times in of_cameras) for stage in of_cameras[0]}


def time_stages_of(workload: Workload, discarded: int, repeats: int) -> dict[str, float]:
    """Median time [ms] of the kernels of each stage, and of SSIM between the rendered image and noise."""
    image = workload.forward()[0].contiguous().requires_grad_()
    noise = torch.rand(image.shape, dtype=torch.float32, generator=torch.Generator().manual_seed(SEED)).to(image.device)
    samples: list[dict[str, float]] = []
    for _ in range(discarded + repeats):
        with profile() as kernels:
            workload.forward_backward()
            torch.autograd.grad(ssim(image, noise), image)
        sums: dict[str, float] = defaultdict(float)
        for kernel in kernels.times():
            sums[STAGE_OF_KERNEL.get(kernel.name, kernel.name)] += kernel.duration_ms
        samples.append(sums)
    samples = samples[discarded:]
    stages = [*STAGES, *(stage for stage in samples[0] if stage not in STAGES)]
    return {stage: statistics.median(sample[stage] for sample in samples) for stage in stages}


def peak_memory(workloads: list[Workload]) -> Measurements:
    """Maximum memory allocated by torch during a forward and backward pass [bytes]; empty on CPU."""
    for workload in workloads:
        workload.forward_backward()
    if not workloads[0].parameters[0].is_cuda:
        return {}
    torch.cuda.reset_peak_memory_stats()
    for workload in workloads:
        workload.forward_backward()
    torch.cuda.synchronize()
    return {"peak_memory_bytes": torch.cuda.max_memory_allocated()}


@torch.no_grad()
def tile_lengths(splats: Splats, camera: Camera, settings: RenderSettings) -> Int32[Tensor, " tiles"]:
    """Number of Gaussians that intersect each tile."""
    geometry = Geometry(splats.means, splats.quats, splats.scales, splats.opacities)
    view = View(camera.viewmat, camera.K, *camera.size)
    features = splats.means  # any will do
    rows, _, order = project_fwd(geometry, features, view, settings.near, settings.antialias, with_depth=False)
    begins, ends = bin_splats(rows, order, camera.size).ranges.unbind(-1)
    return ends - begins


def tail(lengths: Int32[Tensor, " tiles"]) -> Measurements:
    """How unevenly intersections spread over tiles: quantiles, and the share of them in the fullest 1 % of tiles."""
    ordered = lengths.sort().values
    fullest = -(-len(ordered) // 100)
    return {
        "median": int(ordered[len(ordered) // 2]),
        "99_percent": int(ordered[-fullest]),
        "maximum": int(ordered[-1]),
        "share_of_fullest_1_percent": float(ordered[-fullest:].sum() / ordered.sum().clamp_min(1)),
    }


def ratios(measured: Measurements, base: Measurements) -> Measurements:
    """Times relative to those of ``base``; without a graph, plain calls are compared with the graph of ``base``."""
    passes = ("forward", "forward_backward", "one_thread_forward_backward")
    result = {f: measured[f"{f}_ms"] / base[f"{f}_ms"] for f in passes if f"{f}_ms" in base}
    for graph in ("graph_forward", "callable_forward_backward", "graph_forward_backward"):
        if f"{graph}_ms" in base:
            plain = measured[f"{graph.split('_', 1)[1]}_ms"]
            result[graph] = measured.get(f"{graph}_ms", plain) / base[f"{graph}_ms"]
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


def worst(of_cameras: list[Measurements]) -> Measurements:
    """The largest of each difference."""
    first = of_cameras[0]
    values = {name: [of_camera[name] for of_camera in of_cameras] for name in first}
    return {name: worst(found) if isinstance(first[name], dict) else max(found) for name, found in values.items()}
