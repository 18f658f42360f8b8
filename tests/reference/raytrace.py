"""Ray tracing in plain torch, any dtype: every ray against every body, one sample at a time."""

import torch
from torch import Tensor

TUBE = 0.3
FAR = 1e6


def torus(p: Tensor) -> Tensor:
    """Distance of points from the torus."""
    return ((p[:, :2].norm(dim=1) - 1) ** 2 + p[:, 2] ** 2).sqrt() - TUBE


def blob(p: Tensor, bulge: Tensor) -> Tensor:
    """Approximate distance of points from the blob."""
    radius = p.norm(dim=1)
    return radius - 1 - bulge * (p[:, 0] ** 3 - 3 * p[:, 0] * p[:, 1] ** 2) / radius**3


def hit(shape: int, bulge: Tensor, o: Tensor, d: Tensor) -> Tensor:
    """Smallest t > 0 at which each ray meets a unit shape; FAR where it does not."""
    far = torch.full_like(o[:, 0], FAR)
    a, b = (d * d).sum(1), (o * d).sum(1)
    if shape == 0:
        root = b * b - a * ((o * o).sum(1) - 1)
        t = (-b - root.clamp_min(0).sqrt()) / a
        return torch.where((root >= 0) & (t > 0), t, far)
    if shape == 1:
        low, high = (-1 - o) / d, (1 - o) / d
        enter, leave = torch.minimum(low, high).amax(1), torch.maximum(low, high).amin(1)
        t = torch.where(enter > 0, enter, leave)
        return torch.where((enter <= leave) & (t > 0), t, far)
    t = torch.zeros_like(far)
    for _ in range(400):
        p = o + t[:, None] * d
        distance = torus(p) if shape == 2 else blob(p, bulge) / 2
        t = torch.where(distance < 1e-5, t, t + distance / a.sqrt())
    return torch.where((distance < 1e-4) & (t < 100), t, far)


def normal(shape: int, bulge: Tensor, p: Tensor) -> Tensor:
    if shape == 0:
        return p
    if shape == 1:
        return p * torch.nn.functional.one_hot(p.abs().argmax(1), 3)
    if shape == 3:
        with torch.enable_grad():
            q = p.detach().requires_grad_(True)
            (slope,) = torch.autograd.grad(blob(q, bulge).sum(), q)
        return slope
    around = p[:, :2].norm(dim=1, keepdim=True)
    return torch.cat([p[:, :2] - p[:, :2] / around, p[:, 2:]], 1)


def nearest(scene: tuple[Tensor, ...], o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    shapes, bodies, *_, materials = scene
    found = zip(shapes, materials[:, 2], bodies, strict=True)
    ts = [hit(int(k), bulge, o @ m[:, :3].T + m[:, 3], d @ m[:, :3].T) for k, bulge, m in found]
    t, body = torch.stack(ts).min(0)
    return t, torch.where(t < FAR, body, -1)


def noise(x: Tensor, y: Tensor) -> Tensor:
    return (52.9829189 * ((0.06711056 * x + 0.00583715 * y) % 1)) % 1


def checkerboard(p: Tensor, frequency: Tensor) -> Tensor:
    """[N, 1] fraction of the first colour at points of body space."""
    wave = (frequency[:, None] * p + torch.tensor([0.4, 0.9, 1.3], dtype=p.dtype)).sin().prod(1)
    return (0.5 + 0.5 * wave / (wave.abs() + 0.06))[:, None]


def shade(scene, lamp_points, body, p, d, *, mirrors=True):
    """[N, 3] colours of the points p of bodies, hit by rays of the directions d; black where there is no body."""
    shapes, bodies, colors, frequencies, materials = scene
    m = bodies[body]
    local = (m[:, :, :3] @ p[:, :, None])[:, :, 0] + m[:, :, 3]
    n = torch.zeros_like(p)
    for k in range(len(shapes)):
        chosen = body == k
        n[chosen] = normal(int(shapes[k]), materials[k, 2], local[chosen]) @ bodies[k][:, :3]
    n = torch.nn.functional.normalize(n, dim=1)
    view = -torch.nn.functional.normalize(d, dim=1)
    n = torch.where((n * view).sum(1, keepdim=True) < 0, -n, n)
    start = p + 1e-3 * n
    to_light = lamp_points - start
    blocked, _ = nearest(scene, start, to_light)
    light = torch.nn.functional.normalize(to_light, dim=1)
    lit = (blocked >= 1) * (n * light).sum(1).clamp_min(0)
    checks = checkerboard(local, frequencies[body])
    color = checks * colors[body, 0] + (1 - checks) * colors[body, 1]
    ambient = 0.24 + (0.42 - 0.24) * (0.5 + 0.5 * n[:, 2])
    half = torch.nn.functional.normalize(light + view, dim=1)
    gloss = materials[body, 0] * (n * half).sum(1).clamp_min(0) ** 40 * lit
    color = (ambient + 0.72 * lit)[:, None] * color + gloss[:, None]
    if mirrors:
        reflected = 2 * (n * view).sum(1, keepdim=True) * n - view
        t, other = nearest(scene, start, reflected)
        seen = shade(scene, lamp_points, other, start + t[:, None] * reflected, reflected, mirrors=False)
        fraction = materials[body, 1, None]
        color = (1 - fraction) * color + fraction * colors[body, 0] * seen
    return torch.where((body >= 0)[:, None], color, 0.0)


def raytrace(scene, lamp, samples, viewmat, K, size):
    """(image [H, W, 3], depth [H, W], body [H, W]) as warpgs.synthetic.raytrace; ``scene`` has the fields of Bodies."""
    width, height = size
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([column, row], -1).reshape(-1, 2).to(viewmat.dtype)
    R, origin = viewmat[:3, :3], -viewmat[:3, :3].T @ viewmat[:3, 3]

    def rays(offset: Tensor) -> tuple[Tensor, Tensor]:
        slopes = (pixels + offset - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]])
        d = torch.cat([slopes, torch.ones_like(slopes[:, :1])], 1) @ R
        return origin.expand_as(d), d

    column, row = pixels.unbind(1)
    shift = torch.stack([noise(column, row), noise(row, column)], 1)
    total = torch.zeros(len(pixels), 3, dtype=viewmat.dtype)
    for sample in samples:
        o, d = rays(sample[:2])
        t, body = nearest(scene, o, d)
        lamp_points = lamp[0] + (2 * ((sample[2:] + shift) % 1) - 1) @ lamp[1:]
        total += shade(scene, lamp_points, body, o + t[:, None] * d, d)
    t, body = nearest(scene, *rays(torch.full((2,), 0.5, dtype=viewmat.dtype)))
    image = total / len(samples)
    return image.reshape(height, width, 3), t.reshape(height, width), body.reshape(height, width)
