"""Fits an image with Gaussians in front of a fixed camera: the smallest program that optimises ``warpgs.render``.

python examples/fit_image.py                      # scikit-image's astronaut, seconds on two CPU cores
python examples/fit_image.py photo.jpg --width 480 --gaussians 20000 --steps 1000
"""

import argparse
from pathlib import Path

import warpgs  # before torch: several times faster on CPU (docs/design/cpu-shards.md)

# isort: split
import numpy as np
import skimage
import torch
from torch import Tensor


def read_image(path: Path | None, width: int) -> Tensor:
    """Reads an image as [H, W, 3] in [0, 1], scaled to ``width`` pixels."""
    image = skimage.data.astronaut() if path is None else skimage.io.imread(path)
    image = skimage.util.img_as_float(image if image.ndim == 3 else skimage.color.gray2rgb(image))[..., :3]
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return torch.from_numpy(skimage.transform.resize(image, (height, width), anti_aliasing=True).astype(np.float32))


def psnr_of(image: Tensor, target: Tensor, path: Path) -> float:
    """Writes the image to ``path`` and returns its PSNR [dB]."""
    image = image.detach().clamp(0, 1)
    skimage.io.imsave(path, (image * 255).round().byte().cpu().numpy(), check_contrast=False)
    return -10 * (image - target).square().mean().log10().item()


def fit(target: Tensor, num: int, num_steps: int, out: Path) -> tuple[float, float]:
    """Fits ``num`` Gaussians to the target [H, W, 3]; writes before.png and after.png and returns their PSNR [dB]."""
    height, width, _ = target.shape
    aspect = height / width
    origin, up = torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])
    # At distance 1 this camera sees x in [-0.5, 0.5] and y in [-aspect / 2, aspect / 2].
    camera = warpgs.Camera.looking_at(torch.tensor([0.0, 0.0, -1.0]), origin, up, float(width), (width, height))
    camera = camera.to(target.device)
    # Unconstrained values of grey Gaussians all over the image; a little depth gives them an order.
    parameters = {
        "means": (torch.rand(num, 3) - 0.5) * torch.tensor([1.0, aspect, 0.1]),
        "quats": torch.randn(num, 4),
        "log_scales": torch.full((num, 3), 0.5 * (aspect / num) ** 0.5).log(),
        "logit_opacities": torch.zeros(num),
        "colors": torch.full((num, 3), 0.5),
    }
    parameters = {name: value.to(target.device).requires_grad_() for name, value in parameters.items()}
    means, quats, log_scales, logit_opacities, colors = parameters.values()
    rates = {"means": 2e-3, "quats": 2e-2, "log_scales": 2e-2, "logit_opacities": 5e-2, "colors": 2e-2}
    optimizer = torch.optim.Adam([{"params": [parameters[name]], "lr": rate} for name, rate in rates.items()])

    def render() -> Tensor:
        splats = warpgs.Splats(means, quats, log_scales.exp(), logit_opacities.sigmoid(), colors)
        return warpgs.render(splats, camera).joint.image

    before = psnr_of(render(), target, out / "before.png")
    for _ in range(num_steps):
        optimizer.zero_grad()
        (render() - target).square().mean().backward()
        optimizer.step()
    return before, psnr_of(render(), target, out / "after.png")


def main() -> None:
    """Reads the options, fits the image and prints the PSNR before and after."""
    parser = argparse.ArgumentParser(description="Fit an image with Gaussians.")
    parser.add_argument("image", type=Path, nargs="?", help="image file (default: scikit-image's astronaut)")
    parser.add_argument("--width", type=int, default=128, help="width to fit the image at [px] (default: 128)")
    parser.add_argument("--gaussians", type=int, default=2000, help="number of Gaussians (default: 2000)")
    parser.add_argument("--steps", type=int, default=300, help="steps of Adam (default: 300)")
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for before.png and after.png")
    options = parser.parse_args()
    torch.manual_seed(0)
    options.out.mkdir(parents=True, exist_ok=True)
    target = read_image(options.image, options.width).to("cuda" if torch.cuda.is_available() else "cpu")
    before, after = fit(target, options.gaussians, options.steps, options.out)
    print(f"PSNR: {before:.2f} dB before, {after:.2f} dB after {options.steps} steps")


if __name__ == "__main__":
    main()
