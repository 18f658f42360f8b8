"""What comes before the first step, in order: views are read, then each remedy that applies changes the start."""

from dataclasses import replace

import torch

from warpgs.config import Plan, TrainConfig
from warpgs.data.capture import Capture
from warpgs.data.depth_alignment import typical_error
from warpgs.data.dynamic_regions import unknown_depth
from warpgs.data.empty_masks import wrongly_empty
from warpgs.data.responses import camera_responses
from warpgs.errors import command, counted
from warpgs.model.poses import PoseCorrections, shared_places
from warpgs.runtime import ranks
from warpgs.views.views import Views

from .alignment import DepthTrust, align_to_points, require_no_depth
from .exposure import exposure_gains
from .initialize import can_fit_motion
from .object_depth import fill_object_depth
from .plan import describe_segments, make_plan
from .sky import Sky, find_sky
from .start import Remedy, Start, first_scene
from .tracked_start import for_tracks
from .tracks import find_tracks

NO_DEPTH = "training without depth, and without the pretraining that needs it"


def prepare_start(config: TrainConfig, capture: Capture) -> Start:
    """What a new training starts from.

    All ranks of torchrun must call it.

    Args:
        config: What was asked for.
        capture: Capture to train on, as ``open_capture(config)`` reads it.

    Raises:
        ValueError: If a training frame has no mask, it or the tracks are damaged, or it has depth that the config
            excludes, or an option has an unknown value or one that the capture does not suit.
    """
    _ = capture.tracks  # what is damaged is refused now, not after the first stage; copies of the capture keep them
    plan, notes, sky = make_plan(config, capture)
    return _with_remedies(_read(plan, capture, sky, resumed=False).noted(*notes))


def prepare_again(plan: Plan, capture: Capture) -> Start:
    """What a run starts from that was begun with a plan, before its checkpoint is restored; as ``prepare_start``."""
    notes = describe_segments(plan, len(capture.moments))
    sky = find_sky(capture.assuming(plan.assume)) if plan.background == "sky" else None
    return _with_remedies(_read(plan, capture, sky, resumed=True).noted(*notes))


def _with_remedies(start: Start) -> Start:
    for remedy in REMEDIES.values():
        if remedy.applies(start):
            start = remedy.apply(start)
    return start


def _read(plan: Plan, capture: Capture, sky: Sky | None, resumed: bool) -> Start:
    """The start before any remedy."""
    capture = capture.assuming(plan.assume).over(plan.background)
    num, device = len(capture.train), torch.device(plan.device)
    poses = None
    if plan.optim.poses:
        places = shared_places([capture.cameras[name] for name in capture.train])
        poses = PoseCorrections(places, capture.view_size).to(device)
    views = Views(capture, device, plan.resident_bytes, plan.loss.mask_margin, poses, plan.graph)
    start = Start(
        plan,
        capture,
        views,
        first_scene(plan, capture, views, sky),
        torch.full((num, 2), torch.nan, dtype=torch.float32, device=device),
        DepthTrust(*torch.ones(2, num, dtype=torch.float32, device=device)),
        resumed,
        sky=sky,
    )
    if views.resident:
        capture.forget_frames()  # the views hold them
    if (cache := views.cache) is not None:
        read = "read from a file" if cache.fits else "decoded in every iteration: there is no space for a file"
        size = f"views of {cache.nbytes / 1e6:,.0f} MB exceed --resident-bytes or differ in size"
        start = start.noted(f"{size}; {read} in {cache.folder}")
    return start


def _even_exposure(start: Start) -> Start:
    """Divides gains of cameras, as they drift, and jumps of exposure out of the images."""
    gains, notes, capture = exposure_gains(start.views), [], start.capture
    if count := int((gains != 1.0).any(1).sum()):
        low, high = gains.min().item(), gains.max().item()
        notes.append(f"exposure jumps: {counted(count, 'frame')} divided by {low:.2f} to {high:.2f}")
    trained, responses = {*capture.by_camera(capture.train)}, camera_responses(capture)
    for i, response in responses.items():
        told = f"{response} (red, green, blue)"
        if i in trained:
            notes.append(f"camera {i} is divided by its gain of {told}")
        else:
            notes.append(f"camera {i} trains nothing: its own frames tell the gain that it is evaluated with, {told}")
    for k, camera in enumerate(capture.cameras[name] for name in capture.train):
        if camera.id in responses:
            gains[k] *= responses[camera.id].at(camera.time)
    if notes:  # saves steps a division
        start.views.divide_by(gains)
    return start.noted(*notes)


def _may_be_tracked(start: Start) -> bool:
    model = start.plan.model
    if (model.segments or 1) > 1:
        return False
    return not start.resumed and (model.deformation == "splines" or (model.tracks and model.deformation == "mlp"))


def _follow_tracks(start: Start) -> Start:
    """Has dynamic Gaussians start on the tracks of objects that move far from frame to frame."""
    tracks = find_tracks(start.capture, start.views) if start.plan.model.tracks else []
    if tracks:
        objects = counted(len(tracks), "object")
        note = f"dynamic Gaussians start on the tracks of {objects}, which move far from frame to frame"
        return start.planned(for_tracks(start.plan, tracks)).noted(note)
    if start.plan.model.deformation == "splines":
        raise ValueError('model.deformation "splines": no small objects are tracked in this capture; use "mlp"')
    return start


def _can_distrust_masks(start: Start) -> bool:
    """Whether masks are used, and not all that is learned: without a joint image in stage I, nothing else would be."""
    return start.capture.assumption == "masks" and start.plan.schedule.joint_from is not None


def _distrust_masks(start: Start) -> Start:
    """Trusts no masks that are wrongly empty; ``warpgs check`` and the warnings of training name them."""
    names, views = start.capture.train, start.views
    masks = {name: glance.counts for name, glance in zip(names, views.glances, strict=True)}
    for name in wrongly_empty(start.capture.cameras, masks):
        views.mask_trust[names.index(name)] = 0.0
    return start


def _align_depth(start: Start) -> Start:
    """Aligns depth to the sparse points, and refuses depth that is hardly better than a constant."""
    plan = start.plan
    if not plan.depth:
        require_no_depth(start.capture, start.views)
    found = align_to_points(start.capture, start.views, smooth=plan.loss.depth_tolerance > 0.0)
    for tensor in found:
        ranks.copy_first_(tensor)
    trust = found.trust(plan.loss)
    alignments = torch.where(trust.weight[:, None] > 0, found.alignments, torch.nan)
    used = alignments.isfinite().all(1)
    num_aligned, refused, notes = int(used.sum()), int((trust.weight == 0).sum()), []
    if num_aligned and plan.loss.depth > 0.0:
        error, weight = found.errors[used, 0].median().item(), trust.weight[used].median().item()
        notes.append(f"depth is off by {error:.1%} at the sparse points, its weight is {weight:.2f} (medians)")
    if refused:
        notes.append(f"depth of {refused} of {len(used)} views is hardly better than a constant and is not used")
    error = float(typical_error(found.plain_errors))
    start = replace(start, alignments=alignments, trust=trust, num_aligned=num_aligned, depth_error=error)
    return start.noted(*notes)


def _measure_objects(start: Start) -> Start:
    """Gives or corrects the depth of dynamic objects by their size."""
    found = fill_object_depth(start.plan, start.capture, start.views, start.alignments, start.depth_error)
    start = replace(start, num_with_objects=found.num_views)
    num, notes = len(start.views), []
    if found.num_views:
        changed = f"{found.num_views} of {num} views"
        notes.append(f"the size of dynamic objects gives or corrects their depth in {changed}")
    if found.num_cut is not None:
        notes.append(f"warning: {unknown_depth(found.num_cut, num)}")
    return start.noted(*notes)


def _lacks_depth(start: Start) -> bool:
    return not start.plan.depth or start.num_aligned < len(start.views) - int((start.trust.weight == 0).sum())


def _do_without_depth(start: Start) -> Start:
    """Notes which views have no depth, and what is not done then."""
    capture, num_aligned = start.capture, start.num_aligned
    if not start.plan.depth:
        return start.noted(f"depth is switched off: {NO_DEPTH}")
    reason = "" if start.has_depth else f": {NO_DEPTH}"
    # The frame is decoded again, because depth by size is in the views by now.
    if num_aligned or capture.frame(capture.train[0]).inverse_depth is not None:
        aligned = f"{num_aligned} of {len(start.views)} views"
        return start.noted(f"depth can be aligned with the sparse points in {aligned}{reason}")
    made = f", which {command('prepare', start.plan.data, '--add', 'depth')} makes" * (not capture.is_builtin)
    return start.noted(f"the capture has no depth{made}{reason}")


def _lacks_motion(start: Start) -> bool:
    """Whether the deformation was to be fitted to points on what moves, and cannot be."""
    sources = (start.capture, start.views, start.alignments, start.scene.deformation)
    return start.plan.schedule.fit_motion > 0 and not can_fit_motion(*sources)


def _do_without_motion(start: Start) -> Start:
    """Has no deformation fitted before stage I, so that it comes into use later."""
    return replace(start, plan=replace(start.plan, schedule=replace(start.plan.schedule, fit_motion=0)))


REMEDIES: dict[str, Remedy] = {
    "exposure": Remedy(lambda start: start.plan.exposure, _even_exposure),
    "tracks": Remedy(_may_be_tracked, _follow_tracks),
    "empty masks": Remedy(_can_distrust_masks, _distrust_masks),
    "alignment of depth": Remedy(lambda start: True, _align_depth),
    "depth by size": Remedy(lambda start: start.plan.loss.object_depth, _measure_objects),
    "lack of depth": Remedy(_lacks_depth, _do_without_depth),
    "lack of motion": Remedy(_lacks_motion, _do_without_motion),
}
"""Remedies by name, in the order in which they are applied before training."""
