// A camera is {rotation: rows of the world-to-camera rotation, position}. OpenCV axes: x right, y down, z forward.
'use strict';
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const addScaled = (a, b, s) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const normalized = (a) => { const n = Math.hypot(...a) || 1; return a.map((v) => v / n); };

function cameraOf(viewmat) {
  const rotation = viewmat.slice(0, 3).map((row) => row.slice(0, 3)), t = viewmat.slice(0, 3).map((row) => row[3]);
  const position = [0, 1, 2].map((k) => -(rotation[0][k] * t[0] + rotation[1][k] * t[1] + rotation[2][k] * t[2]));
  return {rotation, position};
}

function interpolated(a, b, fraction) {
  // For cameras that are close to each other: interpolates the rows and makes them orthonormal again.
  const lerp = (p, q) => p.map((v, k) => v * (1 - fraction) + q[k] * fraction);
  const z = normalized(lerp(a.rotation[2], b.rotation[2])), x = normalized(cross(lerp(a.rotation[1], b.rotation[1]), z));
  return {rotation: [x, cross(z, x), z], position: lerp(a.position, b.position)};
}

function rotated(vector, axis, angle) {
  // Rodrigues' formula.
  const c = Math.cos(angle), s = Math.sin(angle), along = dot(axis, vector) * (1 - c);
  return addScaled(addScaled(vector.map((v) => v * c), cross(axis, vector), s), axis, along);
}

function outsideOf(filmed, {rotation, position}) {
  // How far a view is outside of what was filmed, with the formulas of warpgs/video/filmed.py; 1 at the border.
  let least = Infinity;
  filmed.positions.forEach((center, k) => {
    const forward = filmed.forwards[k], depth = filmed.depths[k], offset = addScaled(position, center, -1);
    const distance = Math.hypot(...addScaled(offset, forward, -0.5 * dot(offset, forward)));
    const cosine = dot(normalized(addScaled(offset, rotation[2], depth)), forward);
    const turn = Math.acos(Math.max(-1, Math.min(1, cosine)));
    least = Math.min(least, Math.max(distance / (filmed.reach * depth), turn / filmed.angles[k]));
  });
  return least;
}

class Orbit {
  // A camera that orbits a pivot in front of it, about the upward direction of the first view.
  constructor(first, distance) {
    this.first = first;
    this.firstDistance = distance;
    this.up = first.rotation[1].map((v) => -v);
    this.reset();
  }

  reset() {
    this.set(this.first);
  }

  set(camera) {
    this.rotation = camera.rotation;
    this.distance = this.firstDistance;
    this.pivot = addScaled(camera.position, camera.rotation[2], this.distance);
  }

  look(position, target) {
    // From a position at the target, upright.
    const ahead = addScaled(target, position, -1), z = normalized(ahead), side = cross(z, this.up);
    const x = Math.hypot(...side) > 1e-6 ? normalized(side) : this.first.rotation[0]; // straight up or down
    this.rotation = [x, cross(z, x), z];
    this.distance = Math.hypot(...ahead);
    this.pivot = target;
  }

  get camera() {
    return {rotation: this.rotation, position: addScaled(this.pivot, this.rotation[2], -this.distance)};
  }

  rotate(right, down) {
    const slope = dot(this.rotation[2], this.up), tilt = Math.asin(Math.max(-1, Math.min(1, slope)));
    const pitch = Math.max(-1.5, Math.min(1.5, tilt + down)) - tilt; // stops before the pole
    const pitched = this.rotation.map((row) => rotated(row, this.rotation[0], pitch));
    this.rotation = pitched.map((row) => rotated(row, this.up, right));
  }

  pan(right, down) {
    this.pivot = addScaled(addScaled(this.pivot, this.rotation[0], -right * this.distance), this.rotation[1], -down * this.distance);
  }

  zoom(factor) {
    this.distance = Math.max(1e-3, this.distance * factor);
  }

  within(filmed, move, right, down = 0) {
    // Moves as far as the view stays near what was filmed: by the whole step, a part of it, or along one axis alone.
    const {rotation, distance, pivot} = this, before = outsideOf(filmed, this.camera);
    for (const [x, y] of [[1, 1], [0.5, 0.5], [1, 0], [0, 1], [0.25, 0.25]]) {
      move(x * right, y * down);
      const after = outsideOf(filmed, this.camera);
      if (after <= Math.max(filmed.limit, before)) return;
      Object.assign(this, {rotation, distance, pivot});
    }
  }
}
