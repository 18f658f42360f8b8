"""The images along a camera path: layers side by side, supersampled, beside the ground truth, or transparent."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.data.capture import Capture
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.model.dome import Dome
from warpgs.rendering import Layer
from warpgs.runs.trained import TrainedScene
from warpgs.visualize.depth import depth_bounds, depth_image
from warpgs.visualize.images import averaged, to_bytes
from warpgs.visualize.objects import objects_image

from . import camera_paths
from .options import Render

NUM_SAMPLES = 8
"""Number of cameras that decide the range of depths of a path."""

COLORED = ("joint", "static", "dynamic")
"""The layers that ``all`` shows, and that can be transparent."""


def render_frames(
    options: Render, capture: Capture, scene: TrainedScene, cameras: list[Camera], names: list[str]
) -> Iterator[UInt8[np.ndarray, "H W C"]]:
    """Renders the 8-bit RGB or RGBA image of each camera, one at a time."""
    cameras = [sized(options, camera).to(scene.device) for camera in cameras]
    depths = depth_range(scene, cameras) if options.layers == "depth" else None
    for camera, name in progress(list(zip(cameras, names, strict=True)), "rendering", options.quiet):
        images = _images(options, scene, camera, depths)
        if options.truth:
            truth = fitted(capture.frame(name).image.to(scene.device).float() / 255.0, camera)
            images.insert(0, torch.cat([truth, torch.ones_like(truth[..., :1])], -1) if options.transparent else truth)
        yield to_bytes(torch.cat(images, 1))


def sized(options: Render, camera: Camera) -> Camera:
    """A camera with the size of image that the options ask for."""
    if options.size is None:
        return camera_paths.resized(camera, options.scale)
    return camera_paths.filling(camera, options.image_size)


def depth_range(scene: TrainedScene, cameras: list[Camera]) -> tuple[float, float]:
    """Inverse depths that have the first and the last colour in all images of a path, so that colours do not flicker.

    They are percentiles over the pixels of sampled cameras.
    """
    chosen = evenly_spaced_indices(len(cameras), NUM_SAMPLES)
    inverse = np.concatenate([_inverse_depth(scene, cameras[k]).ravel() for k in chosen])
    return depth_bounds(inverse[np.isfinite(inverse)])


@torch.no_grad()
def _images(
    options: Render, scene: TrainedScene, camera: Camera, depths: tuple[float, float] | None
) -> list[Float[Tensor, "H W C"]]:
    """The images of the chosen layers, averaged down from their supersampled size."""
    larger = camera_paths.resized(camera, float(options.supersample))
    if options.layers == "objects":
        image = objects_image(scene.splats(camera.time), larger, scene.config.render_settings)
        return [averaged(torch.from_numpy(image).to(scene.device).float() / 255.0, options.supersample)]
    if depths is not None:
        return [averaged(_depth_image(scene, larger, depths), options.supersample)]
    rendering = scene.render(larger, branches=options.layers not in ("joint", "alpha"))
    if options.layers == "alpha":
        return [averaged(rendering.joint.alpha[..., None].expand(-1, -1, 3), options.supersample)]
    by_name = {"joint": rendering.joint, "static": rendering.static, "dynamic": rendering.dynamic}
    layers = [by_name[name] for name in (COLORED if options.layers == "all" else (options.layers,))]
    behind = scene.background
    colors = behind(larger.to(scene.device)) if isinstance(behind, Dome) else behind
    return [_pixels(layer, options, colors) for layer in layers if layer is not None]


def _pixels(layer: Layer, options: Render, background: Tensor | None) -> Float[Tensor, "H W C"]:
    """RGB over the scene's background; with transparency RGBA, whose colour is not multiplied by its alpha."""
    if not options.transparent:
        return averaged(layer.image.clamp(0, 1), options.supersample)
    image = layer.image if background is None else layer.image - (1.0 - layer.alpha[..., None]) * background
    image = image.clamp(0, 1)
    image = averaged(torch.cat([image, layer.alpha[..., None]], -1), options.supersample)
    alpha = image[..., 3:]
    return torch.cat([image[..., :3] / alpha.clamp_min(1 / 255), alpha], -1).clamp(0, 1)


def _depth_image(scene: TrainedScene, camera: Camera, depths: tuple[float, float]) -> Float[Tensor, "H W 3"]:
    """Inverse depth in colours: red is near, blue is far, black is empty."""
    image = depth_image(_inverse_depth(scene, camera), bounds=depths)
    return torch.from_numpy(image).to(scene.device).float() / 255.0


def _inverse_depth(scene: TrainedScene, camera: Camera) -> Float[np.ndarray, "H W"]:
    """[H, W], NaN where empty."""
    return scene.render(camera, depth=True).joint.inverse_depth.cpu().numpy()


def fitted(image: Float[Tensor, "H W 3"], camera: Camera) -> Float[Tensor, "h w 3"]:
    """An image scaled until it fills a camera's size, then cropped around its middle (``camera_paths.filling``)."""
    if image.shape[:2] == (camera.height, camera.width):
        return image
    height, width = image.shape[:2]
    factor = max(camera.width / width, camera.height / height)
    size = (round(height * factor), round(width * factor))
    channels = image.permute(2, 0, 1)[None]
    scaled = torch.nn.functional.interpolate(channels, size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)
    top, left = (size[0] - camera.height) // 2, (size[1] - camera.width) // 2
    return scaled[top : top + camera.height, left : left + camera.width]
