"""Small captures in the layouts of other programs, each written from the same cameras, points and images.

A camera is described by its centre and its directions right, up and forward in the world; every writer converts that as
its format defines, and ``pixel_of`` projects without any matrix.
"""

import io
import json
import struct
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import av
import numpy as np
import OpenEXR
from scipy.spatial.transform import Rotation

from tests.data.captures import image_of, write_array, write_json, write_png

SIZE = (40, 24)
"""(width, height) [px]."""

FOCAL, CENTER = 45.0, (20.5, 11.0)
COUNT = 12
NAMES = [f"frame_{k:05d}" for k in range(COUNT)]
POINTS = np.random.default_rng(3).uniform(-0.8, 0.8, (60, 3))
DEPTH = 3.9
"""Constant depth of every depth file, about that of the points [world units]."""


def camera(k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Centre, right, up and forward of camera ``k``: on an arc around the origin, a little tilted."""
    angle = 0.12 * k - 0.6
    center = np.array([4.0 * np.sin(angle), -0.5 + 0.1 * k, -4.0 * np.cos(angle)])
    forward = -center / np.linalg.norm(center)
    right = np.cross(forward, np.array([0.1, 1.0, 0.0]))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    return center, right, up, forward


def pixel_of(point: np.ndarray, k: int, principal=CENTER) -> np.ndarray:
    """u, v at which camera ``k`` sees a point of the world [px from the corner]."""
    center, right, up, forward = camera(k)
    ray = point - center
    scale = FOCAL / (ray @ forward)
    return np.array([principal[0] + scale * (ray @ right), principal[1] - scale * (ray @ up)])


def opencv(k: int) -> np.ndarray:
    """[4, 4] camera to world with x right, y down, z forward."""
    center, right, up, forward = camera(k)
    return np.vstack([np.stack([right, -up, forward, center], 1), [0, 0, 0, 1]])


def opengl(k: int) -> np.ndarray:
    """[4, 4] camera to world with x right, y up, z backward."""
    center, right, up, forward = camera(k)
    return np.vstack([np.stack([right, up, -forward, center], 1), [0, 0, 0, 1]])


def image(k: int) -> np.ndarray:
    return image_of(NAMES[k], SIZE)


def static_mask(k: int) -> np.ndarray:
    mask = np.ones((SIZE[1], SIZE[0]), bool)
    mask[6:12, 4 + k : 12 + k] = False
    return mask


def white(mask: np.ndarray) -> np.ndarray:
    return mask.astype(np.uint8) * 255


def write_colmap(root: Path, binary: bool = True) -> Path:
    """Images, masks and inverse depth beside a model with one OPENCV camera without distortion."""
    for k, name in enumerate(NAMES):
        write_png(root / f"images/{name}.png", image(k))
        write_png(root / f"masks/{name}.png.png", white(static_mask(k)))
        write_array(root / f"depths/{name}.npy", np.full(SIZE[::-1], 1 / DEPTH, np.float32))
    (root / "sparse/0").mkdir(parents=True)
    (write_binary_model if binary else write_text_model)(root / "sparse/0")
    return root


def colmap_pose(k: int) -> list[float]:
    """qw qx qy qz tx ty tz, world to camera."""
    pose = np.linalg.inv(opencv(k))
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return [w, x, y, z, *pose[:3, 3]]


PARAMS = [FOCAL, FOCAL, *CENTER, 0.0, 0.0, 0.0, 0.0]


def write_text_model(folder: Path) -> None:
    numbers = " ".join(map(str, PARAMS))
    (folder / "cameras.txt").write_text(f"# comment\n3 OPENCV {SIZE[0]} {SIZE[1]} {numbers}\n")
    images = [f"{k + 1} {' '.join(map(str, colmap_pose(k)))} 3 {NAMES[k]}.png\n" for k in range(COUNT)]
    points_2d = ["", "1.5 2.5 -1"]  # no feature, or one without a point
    lines = [line + points_2d[k % 2] + "\n" for k, line in enumerate(images)]
    (folder / "images.txt").write_text("# comment\n" + "".join(lines))
    points = [f"{j} {x} {y} {z} {j} 20 30 0.5\n" for j, (x, y, z) in enumerate(POINTS)]
    (folder / "points3D.txt").write_text("# comment\n" + "".join(points))


def write_binary_model(folder: Path, params: Sequence[float] = PARAMS) -> None:
    opencv_id = 4
    data = struct.pack("<QIiQQ8d", 1, 3, opencv_id, *SIZE, *params)
    (folder / "cameras.bin").write_bytes(data)
    parts = [struct.pack("<Q", COUNT)]
    for k in range(COUNT):
        parts.append(struct.pack("<I7dI", k + 1, *colmap_pose(k), 3) + f"{NAMES[k]}.png".encode() + b"\0")
        parts.append(struct.pack("<Q", k % 2) + struct.pack("<ddq", 1.5, 2.5, -1) * (k % 2))
    (folder / "images.bin").write_bytes(b"".join(parts))
    parts = [struct.pack("<Q", len(POINTS))]
    for j, point in enumerate(POINTS):
        parts.append(struct.pack("<Q3d3BdQ", j, *point, j, 20, 30, 0.5, 0))
    (folder / "points3D.bin").write_bytes(b"".join(parts))


def write_nerfstudio(root: Path) -> Path:
    """transforms.json with intrinsics per frame, masks, depth in millimetres and points."""
    frames = []
    for k, name in enumerate(NAMES):
        write_png(root / f"images/{name}.png", image(k))
        write_png(root / f"masks/{name}.png", white(static_mask(k)))
        write_png(root / f"depth/{name}.png", np.full(SIZE[::-1], 1000 * DEPTH, np.uint16))
        frame = {"file_path": f"images/{name}.png", "transform_matrix": opengl(k).tolist()}
        frame |= {"mask_path": f"masks/{name}.png", "depth_file_path": f"depth/{name}.png"}
        frames.append({**frame, "fl_x": FOCAL, "fl_y": FOCAL, "cx": CENTER[0], "cy": CENTER[1]})
    fields = {"camera_model": "OPENCV", "w": SIZE[0], "h": SIZE[1], "ply_file_path": "points.ply"}
    write_json(root / "transforms.json", {**fields, "frames": frames[::-1]})
    write_ply(root / "points.ply")
    return root


PROPERTIES = ("double x", "double y", "double z", "uchar red", "uchar green", "uchar blue")
PLY_HEADER = f"ply\nformat {{}} 1.0\nelement vertex {len(POINTS)}\n"
PLY_HEADER += "".join(f"property {name}\n" for name in PROPERTIES) + "end_header\n"


def write_ply(path: Path, encoding: str = "binary_little_endian") -> Path:
    rows = [(*point, j, 20, 30) for j, point in enumerate(POINTS)]
    if encoding == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    else:
        order = "<" if "little" in encoding else ">"
        body = b"".join(struct.pack(f"{order}3d3B", *row) for row in rows)
    path.write_bytes(PLY_HEADER.format(encoding).encode() + body)
    return path


def write_blender(root: Path) -> Path:
    """D-NeRF's three files: even cameras for training, odd ones for the test; the principal point is in the middle."""
    angle = 2.0 * np.arctan(0.5 * SIZE[0] / FOCAL)
    splits: dict[str, list[int]] = {"train": [*range(0, COUNT, 2)], "test": [*range(1, COUNT, 2)], "val": [0]}
    for split, indices in splits.items():
        frames = []
        for j, k in enumerate(indices):
            rgba = np.dstack([image(k), white(static_mask(k))])
            write_png(root / f"{split}/r_{j:03d}.png", rgba)
            frame = {"file_path": f"./{split}/r_{j:03d}", "rotation": 0.3, "time": k / COUNT}
            frames.append({**frame, "transform_matrix": opengl(k).tolist()})
        write_json(root / f"transforms_{split}.json", {"camera_angle_x": angle, "frames": frames})
    return root


def write_llff(root: Path, motion: bool = True) -> Path:
    """poses_bounds.npy, and with ``motion`` the masks, inverse depth and second cameras of NSFF."""
    rows = []
    for k, name in enumerate(NAMES):
        center, right, up, forward = camera(k)
        size = np.array([2.0 * SIZE[1], 2.0 * SIZE[0], 2.0 * FOCAL])  # of images twice as large
        matrix = np.stack([-up, right, -forward, center, size], 1)
        rows.append([*matrix.ravel(), 2.0, 6.0])
        write_png(root / f"images/{name}.png", image(k))
        if motion:
            write_png(root / f"motion_masks/{name}.png", white(~static_mask(k)))
            write_array(root / f"disp/{name}.npy", np.full((12, 20), 0.3, np.float32))
            write_png(root / f"mv_images/{k:05d}/cam02.png", image(k))
            write_png(root / f"mv_masks/{k:05d}/cam02.png", white(~static_mask(k)))
    write_array(root / "poses_bounds.npy", np.array(rows))
    return root


def write_megasam(root: Path) -> Path:
    root.mkdir(parents=True)
    np.savez(
        root / "clip_sgd_cvd_hr.npz",
        images=np.stack([image(k) for k in range(COUNT)]),
        depths=np.full((COUNT, SIZE[1], SIZE[0]), DEPTH, np.float16),
        intrinsic=np.array([[FOCAL, 0, CENTER[0]], [0, FOCAL, CENTER[1]], [0, 0, 1]], np.float32),
        cam_c2w=np.stack([opencv(k) for k in range(COUNT)]).astype(np.float32),
    )
    return root


def exr(values: np.ndarray, channel: str = "Z", compression: str = "ZIP") -> bytes:
    """An OpenEXR image with a channel of half floats."""
    stream = io.BytesIO()
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {channel: values.astype(np.float16)}).write(stream)
    return stream.getvalue()


def write_vipe(root: Path) -> Path:
    """The results of one video: instance 1 moves, instance 2 is the sky."""
    for folder in ("pose", "intrinsics", "rgb", "depth", "mask"):
        (root / folder).mkdir(parents=True)
    indices = np.arange(COUNT)
    np.savez(root / "pose/clip.npz", inds=indices, data=np.stack([opencv(k) for k in range(COUNT)]).astype(np.float32))
    np.savez(root / "intrinsics/clip.npz", inds=indices, data=np.tile([FOCAL, FOCAL, *CENTER], (COUNT, 1)))
    (root / "intrinsics/clip_camera.txt").write_text("".join(f"{k}: PINHOLE\n" for k in range(COUNT)))
    (root / "mask/clip.txt").write_text("1: person\n2: sky\n")
    with zipfile.ZipFile(root / "depth/clip.zip", "w") as depths, zipfile.ZipFile(root / "mask/clip.zip", "w") as masks:
        for k in range(COUNT):
            depths.writestr(f"{k:05d}.exr", exr(np.full(SIZE[::-1], DEPTH)))
            instances = np.where(static_mask(k), 0, 1).astype(np.uint8)
            instances[:3] = 2
            write_png(root / "instances.png", instances)
            masks.writestr(f"{k:05d}.png", (root / "instances.png").read_bytes())
    (root / "instances.png").unlink()
    write_video(root / "rgb/clip.mp4", [image(k) for k in range(COUNT)])
    return root


def write_video(path: Path, images: list[np.ndarray]) -> None:
    """H.264 without chroma subsampling or loss worth mentioning."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = images[0].shape[1], images[0].shape[0], "yuv444p"
        for pixels in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "rgb24")))
        container.mux(stream.encode())


def write_text_colmap(root: Path) -> Path:
    return write_colmap(root, binary=False)


WRITERS: dict[str, Callable[[Path], Path]] = {
    "colmap": write_colmap,
    "nerfstudio": write_nerfstudio,
    "blender": write_blender,
    "llff": write_llff,
    "vipe": write_vipe,
    "megasam": write_megasam,
}
ALL = {**WRITERS, "colmap as text": write_text_colmap}


def edit_transforms(path: Path, **changes: object) -> None:
    """Changes fields of the first frame of a transforms.json; None removes one."""
    values = json.loads(path.read_text())
    frame = {**values["frames"][0], **changes}
    values["frames"][0] = {key: value for key, value in frame.items() if value is not None}
    write_json(path, values)
