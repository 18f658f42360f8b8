// The scene in a headset, by WebXR, with the time, the layers and the order of the page. The axes of the room are x right,
// y up, z backwards, its unit is the metre.
const FIT = 1.5;                                       // distance of what the first view looks at, if units are unknown [m]
const METRES = START.metres || FIT / START.pivot;      // per scene unit, at first
const WALK = 1, SCRUB = 0.25;                          // speeds of the thumbsticks [m/s], [durations/s]
const BAR = {left: -0.2, bottom: -0.33, width: 0.4, height: 0.012, distance: -1, seconds: 2}; // seen from the head [m]
const LEVEL = 0.1;                                     // least horizontal part of an axis that tells a heading
const columns = (matrix) => [0, 4, 8, 12].map((k) => Array.from(matrix.slice(k, k + 3)));

function headingOf(head) {
  // The horizontal direction to the right of a head, by its back where it lies on its side.
  const [right, , back] = columns(head), isLevel = Math.hypot(right[0], right[2]) > LEVEL;
  return normalized(isLevel ? [right[0], 0, right[2]] : [back[2], 0, -back[0]]);
}

class Stage {
  // Where the room is in the scene: its axes, its origin, and metres per scene unit.
  constructor(camera, up, metres, head) {
    // The head gets the place of the camera and its heading, and stays upright.
    const side = addScaled(camera.rotation[0], up, -dot(camera.rotation[0], up)), isLevel = Math.hypot(...side) > LEVEL;
    const x = normalized(isLevel ? side : cross(camera.rotation[2], up)), back = cross(x, up); // a camera may lie on its side
    const [, , , place] = columns(head), [cos, , sin] = headingOf(head);
    this.axes = [addScaled(x.map((v) => v * cos), back, -sin), up, addScaled(x.map((v) => v * sin), back, cos)];
    this.metres = metres;
    this.origin = addScaled(camera.position, this.turned(place), -1 / metres);
  }

  turned(vector) {
    return vector.reduce((sum, value, k) => addScaled(sum, this.axes[k], value), [0, 0, 0]);
  }

  camera(pose) {
    const [x, y, z, place] = columns(pose), rotation = [x, y.map((v) => -v), z.map((v) => -v)];
    return {rotation: rotation.map((row) => this.turned(row)), position: addScaled(this.origin, this.turned(place), 1 / this.metres)};
  }

  move(step) {
    this.origin = addScaled(this.origin, this.turned(step), 1 / this.metres);
  }

  grow(factor, place) {
    // What is at a place of the room stays there.
    this.origin = addScaled(this.origin, this.turned(place), (1 - 1 / factor) / this.metres);
    this.metres *= factor;
  }
}

function intrinsicsOf(projection, {width, height}) {
  // fx, fy, cx, cy [px] of an eye, whose frustum need not be symmetric.
  const [fx, fy] = [projection[0] * width / 2, projection[5] * height / 2];
  return [fx, fy, (1 - projection[8]) * width / 2, (1 + projection[9]) * height / 2];
}

const headset = {session: null, stage: null, head: null, hands: [], barUntil: 0, pressed: false};

async function enter(mode) {
  const session = headset.session = await navigator.xr.requestSession(mode);
  cancelAnimationFrame(state.request);
  session.onend = () => {
    Object.assign(headset, {session: null, stage: null, hands: []});
    dome.hidden = false;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    offer();
    state.changed = true;
    state.request = requestAnimationFrame(frame);
  };
  session.onselect = () => { toggle(); headset.barUntil = before + 1000 * BAR.seconds; };
  offer();
  await gl.makeXRCompatible();
  const layer = new XRWebGLLayer(session, gl, {antialias: false, depth: false, stencil: false});
  session.updateRenderState({baseLayer: layer});
  const space = await session.requestReferenceSpace('local');
  dome.hidden = mode === 'immersive-ar';
  const background = dome.hidden ? [0, 0, 0, 0] : [...START.background, 1];
  const show = (now, frame) => {
    session.requestAnimationFrame(show);
    const pose = frame.getViewerPose(space);
    if (pose) look(frame, space, pose, advance(now), layer, background);
  };
  session.requestAnimationFrame(show);
}

function look(frame, space, pose, seconds, layer, background) {
  // One image per eye; both have the order of the head.
  const head = headset.head = pose.transform.matrix;
  headset.stage ||= new Stage(currentCamera(), START.up, METRES, head);
  steer(frame, space, seconds);
  sortFor(headset.stage.camera(head));
  gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
  gl.clearColor(...background);
  gl.clear(gl.COLOR_BUFFER_BIT);
  for (const view of pose.views) {
    const port = layer.getViewport(view), camera = headset.stage.camera(view.transform.matrix);
    const intrinsics = intrinsicsOf(view.projectionMatrix, port);
    draw(camera, intrinsics, [port.x, port.y, port.width, port.height]);
    if (before < headset.barUntil) drawBar(view, head, intrinsics, port);
  }
  showTime();
}

function steer(frame, space, seconds) {
  const hands = [], {head} = headset, x = headingOf(head);
  let pressed = false;
  for (const {gamepad, gripSpace, handedness} of headset.session.inputSources) {
    if (!gamepad) continue;
    const [right, down] = [...gamepad.axes].slice(-2).map((axis) => Math.abs(axis) < 0.15 ? 0 : axis);
    if (handedness === 'left') walk([x[0] * right - x[2] * down, 0, x[2] * right + x[0] * down], WALK * seconds);
    else {
      walk([0, -down, 0], WALK * seconds);
      if (right) scrub(SCRUB * seconds * right);
    }
    const grip = gamepad.buttons[1]?.pressed && gripSpace && frame.getPose(gripSpace, space);
    if (grip) hands.push(columns(grip.transform.matrix)[3]);
    pressed ||= gamepad.buttons[4]?.pressed;
  }
  if (hands.length === headset.hands.length) pull(headset.hands, hands);
  headset.hands = hands;
  if (pressed && !headset.pressed) headset.stage = new Stage(currentCamera(), START.up, METRES, head); // A or X: back
  headset.pressed = pressed;
}

function walk(step, distance) {
  // Ends where the view leaves what was filmed, as with the mouse.
  const {stage, head} = headset, {origin} = stage, outside = () => FILMED ? outsideOf(FILMED, stage.camera(head)) : 0;
  if (!step.some(Boolean)) return;
  const last = outside();
  stage.move(step.map((v) => v * distance));
  if (FILMED && outside() > Math.max(FILMED.limit, last)) stage.origin = origin;
}

function scrub(step) {
  state.playing = false;
  state.time = Math.min(1, Math.max(0, state.time + step));
  headset.barUntil = before + 1000 * BAR.seconds;
}

function pull(from, to) {
  // One hand that grips moves the scene; two also change its size by their distance.
  if (!to.length) return;
  const middle = (hands) => hands.reduce((sum, hand) => addScaled(sum, hand, 1 / hands.length), [0, 0, 0]);
  const apart = ([a, b]) => Math.max(0.02, Math.hypot(...addScaled(a, b, -1))), place = middle(to);
  headset.stage.move(addScaled(middle(from), place, -1));
  if (to.length === 2) headset.stage.grow(apart(to) / apart(from), place);
}

function drawBar(view, head, [fx, fy, cx, cy], port) {
  // The time, as a bar in front of the head, of which each eye sees its own image.
  const [x, y, z, place] = columns(head), eye = columns(view.transform.matrix);
  const pixel = (right, up) => {
    const point = [[x, right], [y, up], [z, BAR.distance], [place, 1]].reduce((sum, [axis, s]) => addScaled(sum, axis, s), [0, 0, 0]);
    const [a, b, c] = eye.slice(0, 3).map((axis) => dot(axis, addScaled(point, eye[3], -1)));
    return [cx + fx * a / -c, port.height - cy + fy * b / -c];
  };
  const fill = (width, color) => {
    const [left, bottom] = pixel(BAR.left, BAR.bottom), [right, top] = pixel(BAR.left + width, BAR.bottom + BAR.height);
    gl.scissor(port.x + Math.round(left), port.y + Math.round(bottom), Math.max(0, Math.round(right - left)), Math.max(1, Math.round(top - bottom)));
    gl.clearColor(...color);
    gl.clear(gl.COLOR_BUFFER_BIT);
  };
  gl.enable(gl.SCISSOR_TEST);
  fill(BAR.width, [0.2, 0.2, 0.2, 1]);
  fill(BAR.width * state.time, state.playing ? [0.9, 0.9, 0.9, 1] : [1, 0.8, 0.4, 1]);
  gl.disable(gl.SCISSOR_TEST);
}

function offer() {
  // A button for each kind of session that the browser has a device for.
  for (const [id, mode] of [['vr', 'immersive-vr'], ['ar', 'immersive-ar']]) {
    const button = element(id);
    button.textContent = `${headset.session ? 'leave' : 'enter'} ${id.toUpperCase()}`;
    button.onclick = () => headset.session ? headset.session.end() : enter(mode).catch((error) => {
      headset.session?.end();
      element('message').textContent = `The headset could not be used: ${error.message}`;
    });
    navigator.xr?.isSessionSupported(mode).then((supported) => { button.hidden = !supported; }, () => {});
  }
}
loaded.then(() => { // a session that began before would share the canvas with the loop that begins then
  navigator.xr?.addEventListener('devicechange', offer);
  offer();
}, () => {});
