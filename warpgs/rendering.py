"""Differentiable rendering: splats, camera, background → images."""

import dataclasses
import threading
from functools import partial
from typing import Any, NamedTuple, TypeGuard

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from .cameras import Camera
from .config import RenderSettings
from .model.dome import MIN_SEEN, Dome
from .model.splats import Splats
from .ops.compositing import NUM_BRANCH_IMAGES, Traversal, background_bwd, composite_bwd, composite_fwd
from .ops.projection import Geometry, View, project_bwd, project_fwd
from .ops.rows import Rows
from .ops.sh import degree_of, sh_bwd, sh_fwd
from .ops.tiles import bin_splats
from .runtime.checks import check_same_device, check_tensor
from .runtime.tape import Gradients, Recorded, Tape, differentiable

DEFAULTS = RenderSettings()

MIN_ALPHA = 0.5
"""A pixel has an inverse depth where it is at least this opaque."""


class Layer(NamedTuple):
    """One image.

    Attributes:
        image: [H, W, C] composited over the background.
        alpha: [H, W] opacity, in [0, 1).
        depth: [H, W] mean depth of the Gaussians, weighted by their contribution [scene units], or their median depth;
            0 in empty pixels. None unless requested.
    """

    image: Float[Tensor, "H W C"]
    alpha: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"] | None

    def only_where(self, shown: Bool[Tensor, "H W"], elsewhere: Float[Tensor, "... C"]) -> "Layer":
        """The layer with an image that has other colours where pixels show nothing (``Camera.shown``)."""
        return self._replace(image=torch.where(shown[..., None], self.image, elsewhere))

    def under(self, sky: Float[Tensor, "H W 3"]) -> "Layer":
        """The layer, which is over black, with colours of the sky behind it, which learn from pixels that show them."""
        passes = (1.0 - self.alpha)[..., None]
        behind = torch.where(passes.detach() >= MIN_SEEN, sky, sky.detach())
        return self._replace(image=self.image + passes * behind)

    @property
    def inverse_depth(self) -> Float[Tensor, "H W"]:
        """[H, W] inverse depth; NaN where empty."""
        assert self.depth is not None
        visible = (self.alpha >= MIN_ALPHA) & (self.depth > 0)
        return torch.where(visible, 1.0 / self.depth, torch.nan)


class Rendering(NamedTuple):
    """The result of ``render``.

    Attributes:
        joint: All Gaussians.
        static: The static Gaussians alone; None unless requested.
        dynamic: The dynamic Gaussians alone; None unless requested.
        radii: [N, 2] half sizes on screen [px]; 0 = culled.
        contributed: [N] whether the Gaussian changed a pixel of the joint image; None unless requested.
        weights: [N] sum of its blend weights over the joint image, not differentiable; None unless requested.
        num_intersections: [1] int64 number of intersections of Gaussians with tiles, on the device; None unless
            ``RenderSettings.max_intersections`` is set. If it is larger, the images are the same, but rendered slowly.
    """

    joint: Layer
    static: Layer | None
    dynamic: Layer | None
    radii: Int32[Tensor, "N 2"]
    contributed: Bool[Tensor, " N"] | None
    weights: Float[Tensor, " N"] | None
    num_intersections: Int64[Tensor, "1"] | None

    def under(self, sky: Float[Tensor, "H W 3"]) -> "Rendering":
        """The same rendering, which is over black, with colours of the sky behind all its images."""
        joint, static, dynamic = (layer and layer.under(sky) for layer in self[:3])
        assert joint is not None
        return self._replace(joint=joint, static=static, dynamic=dynamic)


class _Request(NamedTuple):
    """Everything but tensors that a render depends on."""

    size: tuple[int, int]
    lens: tuple[float, str]
    by_columns: bool
    settings: RenderSettings
    num_features: int
    sh_degree: int | None


class _Inputs(NamedTuple):
    """All tensors that a render depends on."""

    means: Any
    quats: Any
    scales: Any
    opacities: Any
    appearance: Any
    viewmat: Any
    K: Any
    distortion: Any
    motion: Any
    background: Any
    screen_offsets: Any
    branch: Any


class _Saved(NamedTuple):
    """The tensors that autograd saves for the backward pass, besides some layers.

    ``sh`` and ``colors``, those of it, are None without spherical harmonics; ``packed`` are the splats' rows.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    viewmat: Tensor
    K: Tensor
    distortion: Tensor | None
    motion: Tensor | None
    background: Tensor | None
    sh: Any
    colors: Any
    packed: Tensor


def render(
    splats: Splats,
    camera: Camera,
    background: Float[Tensor, " C"] | Float[Tensor, "3 C"] | Dome | None = None,
    settings: RenderSettings | None = None,
    screen_offsets: Float[Tensor, "N 2"] | None = None,
) -> Rendering:
    """Renders splats through a camera; differentiable, once, in the splats, the camera and the background.

    Gaussians that are behind the near plane, 1e10 or more from the camera, outside the image, fainter than 1/255 or
    that have an opacity above 1, a parameter or offset that is not finite or a zero quaternion are culled: they leave
    the image unchanged and get zero gradients.

    Args:
        splats: N Gaussians; N may be 0.
        camera: On the device of the splats.
        background: [C] colour behind everything, or the sky; with branches also [3, C], one for each of the joint, the
            static and the dynamic image. By default that of the splats, which is black if they have none or C is not 3.
        settings: What to compute besides the joint image.
        screen_offsets: [N, 2] offsets of the Gaussians' means on screen in normalised device coordinates (halves of the
            image size), as a rule zeros. The length of their gradient is the densification statistic of 3DGS.

    Raises:
        TypeError: If the camera is something else, such as a list of cameras.
        ValueError: If the background or the offsets do not fit the splats, devices differ, or branches are requested
            for splats without ``is_dynamic``, or median depth where a gradient is.
        RuntimeError: If a CUDA graph captures the first render of an image size without
            ``RenderSettings.max_intersections``.
    """
    settings = settings or DEFAULTS
    if background is None and splats.num_channels == 3:
        background = splats.background
    dome, background = (background, None) if isinstance(background, Dome) else (None, background)
    _check_inputs(splats, camera, background, settings, screen_offsets)
    render_all = _rendered_around if camera.is_panorama else _rendered
    rendering = render_all(splats.seen_from(camera.viewmat), camera, screen_offsets, background, settings)
    return rendering if dome is None else rendering.under(dome(camera))


def _rendered(
    splats: Splats, camera: Camera, screen_offsets: Tensor | None, background: Tensor | None, settings: RenderSettings
) -> Rendering:
    inputs = _inputs(splats, camera, background, settings, screen_offsets)
    if settings.median and torch.is_grad_enabled() and any(map(_has_gradient, inputs)):
        raise ValueError("median depth has no gradient: render it with torch.no_grad()")
    outputs = differentiable(partial(_forward, _request(splats, camera, settings)), *inputs)
    return _rendering(outputs, settings)


def _rendered_around(
    splats: Splats, camera: Camera, screen_offsets: Tensor | None, background: Tensor | None, settings: RenderSettings
) -> Rendering:
    splats, screen_offsets = _twice(splats, camera, screen_offsets)
    return _once(_rendered(splats, camera, screen_offsets, background, settings))


def _twice(splats: Splats, camera: Camera, screen_offsets: Tensor | None) -> tuple[Splats, Float[Tensor, "M 2"]]:
    """Splats and once more the same, 360 degrees away: there, those are seen that reach across a panorama's border.

    Returns:
        The 2 N splats, and the offsets of their means on screen.
    """
    tensors = {name: getattr(splats, name) for name in Splats.tensor_names()}
    twice: dict[str, Any] = {
        name: torch.cat([tensor, tensor]) for name, tensor in tensors.items() if tensor is not None
    }
    _, column, *_ = camera.project(splats.means.detach())
    turn = 4.0 * torch.pi * camera.K[0, 0] / camera.width  # 360 degrees in halves of the width
    shift = torch.where(column < camera.width / 2, turn, -turn)
    offsets = torch.zeros_like(splats.means[:, :2]) if screen_offsets is None else screen_offsets
    again = offsets + torch.stack([shift, torch.zeros_like(shift)], 1)
    return dataclasses.replace(splats, **twice), torch.cat([offsets, again])


def _once(rendering: Rendering) -> Rendering:
    """The rendering of ``_twice`` with values of each of the splats."""

    def of_both(values: Tensor) -> Tensor:
        return values.unflatten(0, (2, len(values) // 2))

    contributed, weights = rendering.contributed, rendering.weights
    return rendering._replace(
        radii=of_both(rendering.radii).amax(0),
        contributed=None if contributed is None else of_both(contributed).any(0),
        weights=None if weights is None else of_both(weights).sum(0),
    )


@torch.no_grad()
def opacities_on_screen(splats: Splats, camera: Camera, settings: RenderSettings = DEFAULTS) -> Float[Tensor, " N"]:
    """[N] opacities with which ``render`` composites splats: with ``antialias`` compensated, of culled ones 0."""
    geometry = Geometry(splats.means, splats.quats, splats.scales, splats.opacities)
    view = View(camera.viewmat, camera.K, *camera.size, _coefficients(camera), *_lens(camera), camera.motion)
    view = view._replace(by_columns=camera.by_columns)
    rows, *_ = project_fwd(geometry, splats.means, view, settings.near, settings.antialias, with_depth=False)
    return rows.opacities


def _request(splats: Splats, camera: Camera, settings: RenderSettings) -> _Request:
    degree = None
    if splats.sh is not None:
        degree = degree_of(splats.sh.shape[1]) if splats.sh_degree is None else splats.sh_degree
    return _Request(camera.size, _lens(camera), camera.by_columns, settings, splats.num_channels, degree)


def _lens(camera: Camera) -> tuple[float, str]:
    """``View.limit`` and ``View.lens``."""
    return (0.0, "pinhole") if camera.distortion is None else (camera.distortion.limit, camera.distortion.lens)


def _coefficients(camera: Camera) -> Tensor | None:
    return None if camera.distortion is None else camera.distortion.coefficients


def _view(tensors: _Inputs | _Saved, request: _Request) -> View:
    view = View(tensors.viewmat, tensors.K, *request.size, tensors.distortion, *request.lens, tensors.motion)
    return view._replace(by_columns=request.by_columns)


def _inputs(
    splats: Splats, camera: Camera, background: Tensor | None, settings: RenderSettings, screen_offsets: Tensor | None
) -> _Inputs:
    geometry = splats.means, splats.quats, splats.scales, splats.opacities
    appearance = splats.colors if splats.sh is None else splats.sh
    branch = splats.is_dynamic.view(torch.uint8) if settings.branches and splats.is_dynamic is not None else None
    view = camera.viewmat, camera.K, _coefficients(camera), camera.motion
    return _Inputs(*geometry, appearance, *view, background, screen_offsets, branch)


def _rendering(outputs: tuple[Tensor, ...], settings: RenderSettings) -> Rendering:
    """Gives names to the outputs of ``_forward``."""
    n = NUM_BRANCH_IMAGES if settings.branches else 1
    first = (3 if settings.depth else 2) * n  # of the outputs that are not layers
    layers = [Layer(outputs[k], outputs[n + k], outputs[2 * n + k] if settings.depth else None) for k in range(n)]
    static, dynamic = layers[1:] if settings.branches else (None, None)
    contributed, weights = outputs[first + 1 : first + 3] if settings.statistics else (None, None)
    num_intersections = None if settings.max_intersections is None else outputs[-1]
    return Rendering(layers[0], static, dynamic, outputs[first], contributed, weights, num_intersections)


def require_camera(camera: object) -> None:
    """Raises TypeError for everything but a camera."""
    if not isinstance(camera, Camera):
        raise TypeError(f"camera must be one Camera, got {type(camera).__name__}: call render once per camera")


def _check_inputs(
    splats: Splats, camera: Camera, background: Tensor | None, settings: RenderSettings, screen_offsets: Tensor | None
) -> None:
    require_camera(camera)
    if background is not None:
        is_per_image = settings.branches and isinstance(background, Tensor) and background.ndim == 2
        C = splats.num_channels
        check_tensor("background", background, (NUM_BRANCH_IMAGES, C) if is_per_image else (C,), {})
    if screen_offsets is not None:
        check_tensor("screen_offsets", screen_offsets, ("N", 2), {"N": len(splats.means)})
    tensors = {"background": background, "screen_offsets": screen_offsets}
    check_same_device({"splats": splats.means, "camera": camera.viewmat, **tensors})
    if settings.branches and splats.is_dynamic is None:
        raise ValueError("branches were requested, but splats.is_dynamic is None")


def _forward(request: _Request, *tensors: Any) -> Recorded:
    """(color →) project → bin → composite; every differentiable step records its backward function on one tape."""
    inputs, (size, _, _, settings, _, sh_degree) = _Inputs._make(tensors), request
    geometry, view = Geometry(*inputs[:4]), _view(inputs, request)
    back, tape = _Backward(request, _has_gradient(inputs.screen_offsets)), Tape()

    features, sh, colors = inputs.appearance, None, None
    if sh_degree is not None:
        sh = inputs.appearance
        features = colors = sh_fwd(inputs.means, sh, inputs.viewmat, sh_degree)
        tape.record_func(back.color, [])
    options = (settings.near, settings.antialias, settings.depth)
    rows, radii, order = project_fwd(geometry, features, view, *options, inputs.screen_offsets)
    tape.record_func(back.project, [])
    tiles = bin_splats(rows, order, size, inputs.branch, settings.max_intersections)
    composite, back.traversal = composite_fwd(
        rows, tiles, size, inputs.background, settings.statistics, settings.max_alpha, settings.median
    )
    tape.record_func(back.composite, [])

    alphas = composite.alphas if _has_gradient(inputs.background) else ()
    saved = _Saved(*geometry, *inputs[5:9], inputs.background, sh, colors, rows.packed)
    num_intersections = () if settings.max_intersections is None else (tiles.num_isects,)
    return Recorded(
        outputs=composite.layers,
        backward=partial(_backward, back, tape),
        saved=(*saved, *composite.depths, *alphas),
        constants=(radii, *composite.statistics, *num_intersections),
    )


def _backward(back: "_Backward", tape: Tape, saved: tuple[Any, ...], v_layers: Gradients) -> Gradients:
    """composite → project (→ color): plays the tape in reverse."""
    num_saved = len(_Saved._fields)
    with back.lock:
        back.saved, back.layers, back.v = _Saved._make(saved[:num_saved]), saved[num_saved:], {"layers": v_layers}
        try:
            tape.backward()
            return [back.v.get(name) for name in _Inputs._fields]
        finally:
            del back.saved, back.layers, back.v  # outputs among them would keep their own node alive


class _Backward:
    """The backward pass of one render: the tape calls ``composite``, ``project`` and, with harmonics, ``color``.

    Attributes:
        request: Of the render.
        with_offsets: Whether ``screen_offsets`` get a gradient.
        absgrad: Whether it is the sum of absolute values over pixels.
        lock: Held during the backward pass: threads may run it on one graph at once.
        traversal: Of the forward pass.
        saved: What autograd saved; during the backward pass only, as all that follows.
        layers: The depths, which torch checks for changes, and the alphas if the background requires a gradient.
        v: Gradients so far: of inputs by their names, and of all layers and ``rows``.
    """

    traversal: Traversal
    saved: _Saved
    layers: tuple[Tensor, ...]
    v: dict[str, Any]

    def __init__(self, request: _Request, with_offsets: bool) -> None:
        self.request, self.with_offsets, self.lock = request, with_offsets, threading.Lock()
        self.absgrad = request.settings.absgrad and with_offsets

    def composite(self) -> None:
        saved, traversal, v = self.saved, self.traversal, self.v
        v["rows"] = composite_bwd(self._rows(), saved.background, traversal, v["layers"], self.absgrad)
        if _has_gradient(saved.background):
            alphas = self.layers[-traversal.num_images :]
            v["background"] = background_bwd(saved.background, alphas, v["layers"][: traversal.num_images])

    def project(self) -> None:
        saved, v = self.saved, self.v
        geometry = Geometry(*saved[:4])
        inputs = (geometry, _view(saved, self.request), self.request.settings.antialias, self._rows())
        splats = project_bwd(*inputs, v["rows"], self.with_offsets, self.absgrad)
        v |= splats.geometry._asdict()
        v["appearance"], v["viewmat"], v["K"] = splats.features, splats.viewmat, splats.K
        v["distortion"], v["motion"] = splats.distortion, splats.motion
        v["screen_offsets"] = splats.screen_offsets

    def color(self) -> None:
        saved, v, degree = self.saved, self.v, self.request.sh_degree
        assert degree is not None
        inputs = (saved.means, saved.sh, saved.viewmat)
        v_colors = v["appearance"]  # what was projected
        v["appearance"], v_viewmat = sh_bwd(inputs, degree, saved.colors, v_colors, v["means"])
        if v_viewmat is not None:
            v["viewmat"] += v_viewmat

    def _rows(self) -> Rows:
        return Rows(self.saved.packed, self.request.num_features, self.request.settings.depth)


def _has_gradient(tensor: Tensor | None) -> TypeGuard[Tensor]:
    return tensor is not None and tensor.requires_grad
