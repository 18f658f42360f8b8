"""The whole render in plain torch, any dtype."""

from torch import Tensor

from tests.reference import compositing, projection, sh
from warpgs.cameras import Camera
from warpgs.model.splats import Splats
from warpgs.ops.projection import Geometry, View


def render(
    tensors: dict[str, Tensor],
    camera: Camera,
    background: Tensor,
    selected: Tensor | None = None,
    antialias: bool = False,
    max_alpha: float = 0.999,
) -> tuple[Tensor, Tensor, Tensor]:
    """image, alpha, weights for a dict of ``Splats`` tensors; ``selected`` [N] restricts the splats to a branch."""
    dtype = tensors["means"].dtype
    viewmat, K = camera.viewmat.to(dtype), camera.K.to(dtype)
    geometry = Geometry(*(tensors[name] for name in Geometry._fields))
    *splats, visible = projection.project(geometry, View(viewmat, K, *camera.size), antialias=antialias)
    if tensors.get("colors") is not None:
        features = tensors["colors"]
    else:
        degree = round(tensors["sh"].shape[1] ** 0.5) - 1
        features = sh.spherical_harmonics(tensors["means"], tensors["sh"], viewmat, degree)
    visible = visible if selected is None else visible & selected
    return compositing.composite(splats, features, visible, camera.size, background, max_alpha)


def as_dict(splats: Splats, **changes: Tensor) -> dict[str, Tensor]:
    """The tensors of splats by name, in double precision."""
    named = {name: getattr(splats, name) for name in Splats.tensor_names()}
    return {name: t.double() if t is not None and t.is_floating_point() else t for name, t in named.items()} | changes
