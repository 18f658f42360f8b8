"""Spark (three.js) renders exported files as warpgs does; skipped without Chromium and Spark.

``npm install --global @sparkjsdev/spark three``. Version 2.2 reads SPZ up to version 3.
"""

import json
from urllib.parse import quote

import numpy as np
import pytest

from tests.export import node, scenes
from tests.export.browser import Browser, executable, served
from warpgs.formats.compressed import write_compressed
from warpgs.formats.rotation import rotated
from warpgs.formats.sog import write_sog
from warpgs.formats.spz import write_spz_gzip
from warpgs.formats.standard import write_standard
from warpgs.video import orientation
from warpgs.video.camera_paths import UP

pytestmark = [
    pytest.mark.skipif(executable() is None, reason="the test needs Chromium"),
    pytest.mark.skipif(not node.has("@sparkjsdev/spark", "three"), reason="Spark is not installed"),
]

SIZE = (160, 120)

FILES = {
    "a.ply": (write_standard, False),
    "a.compressed.ply": (write_compressed, False),
    "a.sog": (write_sog, False),
    "a.spz": (write_spz_gzip, True),
}
"""Functions that write a file, and whether y is up in it."""

BLUR = {False: {"preBlurAmount": 0.3, "blurAmount": 0.0}, True: {}}
"""Options of Spark by whether opacities compensate for the low-pass filter; its defaults are for those that do."""

PAGE = """<!doctype html>
<style>body { margin: 0 } canvas { display: block }</style>
<link rel="icon" href="data:,">
<script type="importmap">{"imports": {
  "three": "/npm/three/build/three.module.js",
  "three/addons/": "/npm/three/examples/jsm/",
  "@sparkjsdev/spark": "/npm/@sparkjsdev/spark/dist/spark.module.js"
}}</script>
<script type="module">
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";

const options = JSON.parse(decodeURIComponent(location.hash.slice(1)));
const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
renderer.setPixelRatio(1);
renderer.setSize(options.width, options.height);
renderer.setClearColor(0, 1);
document.body.append(renderer.domElement);
// Sorted by depth as 3DGS does; colours above 1 are not clipped before they are blended.
const spark = new SparkRenderer({ renderer, sortRadial: false, accumExtSplats: true, ...options.spark });
const scene = new THREE.Scene();
const mesh = new SplatMesh({ url: options.file });
if (!options.yUp) mesh.quaternion.set(1, 0, 0, 0);
scene.add(spark, mesh);
const fieldOfView = 2 * Math.atan(options.height / 2 / options.focal) * 180 / Math.PI;
const camera = new THREE.PerspectiveCamera(fieldOfView, options.width / options.height, 0.01, 100);
camera.position.z = 3;
try {
  await mesh.initialized;
  for (let sorted = 0; sorted < 3; sorted += !spark.sorting && !spark.sortDirty) {
    renderer.render(scene, camera);
    await new Promise(requestAnimationFrame);
  }
  window.count = mesh.packedSplats.numSplats;
} catch (error) {
  window.problem = String(error);
}
</script>
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder that is served, and its address."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "npm").symlink_to(node.packages())
    (folder / "index.html").write_text(PAGE)
    with served(folder) as address:
        yield folder, address


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile"), *SIZE) as browser:
        yield browser


def rendered(browser, address, **options):
    """The image [H, W, 3] in [0, 1] that Spark renders, and the number of Gaussians that it read."""
    options |= {"width": SIZE[0], "height": SIZE[1], "focal": float(scenes.camera(*SIZE).K[0, 0])}
    browser.open(f"{address}#{quote(json.dumps(options))}")
    browser.until("'count' in window || 'problem' in window")
    assert browser.value("window.problem") is None
    return browser.screenshot() / 255, browser.value("window.count")


@pytest.mark.parametrize(
    ("name", "degree", "antialias"), [("a.ply", 0, True), ("a.ply", 1, False), *((name, 3, False) for name in FILES)]
)
def test_spark_renders_the_scene(browser, site, name, degree, antialias):
    (folder, address), (write, y_up) = site, FILES[name]
    cloud = scenes.cloud(300, degree).replaced(antialias=antialias)
    file = f"degree-{degree}-{name}"  # its own: the browser caches by name and second
    write(folder / file, rotated(cloud, orientation.upright(UP, y_up)))
    image, count = rendered(browser, address, file=file, yUp=y_up, spark=BLUR[antialias])
    truth = scenes.image(cloud, scenes.camera(*SIZE)).numpy()
    assert count == 300
    assert truth.std() > 0.1
    psnr = -10 * np.log10(np.square(image - truth).mean())
    assert psnr > 38
