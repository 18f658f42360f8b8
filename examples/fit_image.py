"""Fits an image with Gaussians in front of a fixed camera: the smallest program that optimises ``warpgs.render``.

python examples/fit_image.py                      # scikit-image's astronaut, seconds on two CPU cores
python examples/fit_image.py photo.jpg --width 480 --gaussians 20000 --steps 1000
"""

import argparse
from pathlib import Path

import warpgs  # before torch, whose threads it sets for the CPU (docs/design/cpu.md)

# isort: split
import skimage
import torch
from torch import Tensor

from warpgs.files import write_png
from warpgs.visualize.images import to_bytes


def fit(target: Tensor, num: int, num_steps: int) -> tuple[Tensor, Tensor]:
    """Fits ``num`` Gaussians to the target [H, W, 3]; returns their images before and after."""
    height, width, _ = target.shape
    aspect, device = height / width, target.device
    # At distance 1 this camera sees x in [-0.5, 0.5] and y in [-aspect / 2, aspect / 2].
    position, origin, up = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    camera = warpgs.Camera.looking_at(position, origin, up, float(width), (width, height)).to(device)
    # Unconstrained values of grey Gaussians all over the image; a little depth gives them an order.
    means = (torch.rand(num, 3) - 0.5) * torch.tensor([1.0, aspect, 0.1])
    log_scales = torch.full((num, 3), 0.5 * (aspect / num) ** 0.5).log()
    start = (means, torch.randn(num, 4), log_scales, torch.zeros(num), torch.full((num, 3), 0.5))
    parameters = [value.to(device).requires_grad_() for value in start]
    means, quats, log_scales, logit_opacities, colors = parameters
    optimizer = torch.optim.Adam([{"params": [means], "lr": 2e-3}, {"params": parameters[1:]}], lr=2e-2)

    def render() -> Tensor:
        splats = warpgs.Splats(means, quats, log_scales.exp(), logit_opacities.sigmoid(), colors)
        return warpgs.render(splats, camera).joint.image

    before = render().detach()
    for _ in range(num_steps):
        optimizer.zero_grad()
        (render() - target).square().mean().backward()
        optimizer.step()
    return before, render().detach()


def main() -> None:
    """Reads the options and the image, fits it, writes before.png and after.png and prints their PSNR."""
    parser = argparse.ArgumentParser(description="Fit an image with Gaussians.")
    parser.add_argument("image", type=Path, nargs="?", help="image file (default: scikit-image's astronaut)")
    parser.add_argument("--width", type=int, default=128, help="width to fit the image at [px] (default: 128)")
    parser.add_argument("--gaussians", type=int, default=2000, help="number of Gaussians (default: 2000)")
    parser.add_argument("--steps", type=int, default=300, help="steps of Adam (default: 300)")
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for before.png and after.png")
    options = parser.parse_args()
    torch.manual_seed(0)
    image = skimage.io.imread(options.image) if options.image else skimage.data.astronaut()
    image = skimage.util.img_as_float(image if image.ndim == 3 else skimage.color.gray2rgb(image))[..., :3]
    height = max(1, round(image.shape[0] * options.width / image.shape[1]))
    target = torch.from_numpy(skimage.transform.resize(image, (height, options.width), anti_aliasing=True)).float()
    target = target.to("cuda" if torch.cuda.is_available() else "cpu")
    for name, image in zip(("before", "after"), fit(target, options.gaussians, options.steps), strict=True):
        write_png(options.out / f"{name}.png", to_bytes(image))
        print(f"{name}: {-10 * (image.clamp(0, 1) - target).square().mean().log10():.2f} dB PSNR")


if __name__ == "__main__":
    main()
