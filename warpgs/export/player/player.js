const element = (id) => document.getElementById(id);
const SCENE = JSON.parse(element('scene').textContent);
const START = SCENE.start, FILMED = SCENE.filmed, NAMES = ['static', 'dynamic'], BRANCHES = NAMES.map((name) => SCENE.branches[name]);
const WIDTH = 2048; // texels per row
const lastKey = SCENE.keys - 1;

function fail(text) {
  element('message').textContent = text;
  document.body.dataset.state = 'failed';
  throw new Error(text);
}

// Data ---------------------------------------------------------------------------------------------------------------

const BASIS_UNIT = 1e-4;
const REPLACED = [0, 13, 60]; // NUL, CR and <, which a page cannot hold
function bytesOf(text) {
  // Seven bits per character; one from 128 on stands for a replaced one and the next, from 512 on for one without a next.
  const bytes = new Uint8Array(Math.ceil(text.length * 14 / 8));
  let count = 0, bits = 0, held = 0;
  const add = (value) => {
    bits = (bits << 7 | value) & 0x3fff;
    held += 7;
    if (held >= 8) bytes[count++] = bits >> (held -= 8);
  };
  for (let i = 0; i < text.length; i++) {
    const code = text.charCodeAt(i);
    if (code >= 128 && code < 512) add(REPLACED[(code >> 7) - 1]);
    add(code & 127);
  }
  return bytes.subarray(0, count);
}

async function integers(id, count) {
  const block = element(id), packed = bytesOf(block.textContent);
  block.remove();
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('gzip'));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer()), values = new Int32Array(count);
  for (let p = 0; p * count < planes.length; p++) for (let i = 0; i < count; i++) values[i] |= planes[p * count + i] << (8 * p);
  return values.map((bits) => (bits >>> 1) ^ -(bits & 1)); // the lowest bit is the sign
}

async function unpacked(name, part, octaves) {
  // Values as [key][channel][Gaussian], from quantised coefficients; the "keys" of rest are coefficients of harmonics.
  const {shape: [keys, num, channels], steps} = SCENE.branches[name][part], frame = num * channels;
  const levels = await integers(`${name}-${part}`, keys * frame), basis = await integers(`${name}-${part}-basis`, keys * keys);
  const values = new Float32Array(keys * frame), ownSteps = part === 'colors' || part === 'rest';
  for (let key = 0; key < keys; key++) for (let c = 0; c < channels; c++) for (let i = 0, sum = 0; i < num; i++) {
    const level = levels[(key * channels + c) * num + i];
    sum = part === 'means' && !key ? sum + level : level; // differences along the curve
    const value = sum * steps[c] * BASIS_UNIT * (ownSteps ? 2 ** octaves[i] : 1);
    if (value) for (let t = 0; t < keys; t++) values[t * frame + c * num + i] += basis[key * keys + t] * value;
  }
  return values;
}

function boundsOf(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) { low = Math.min(low, value); high = Math.max(high, value); }
  return low < high ? [low, high] : [Number.isFinite(low) ? low : 0, (Number.isFinite(low) ? low : 0) + 1];
}

const quantised = (value, [low, high], steps) => Math.min(steps, Math.max(0, Math.round((value - low) / (high - low) * steps)));

function toColors(values, num) {
  // From luma and chroma to red, green and blue, in place.
  for (let plane = 0; plane < values.length; plane += 3 * num) for (let i = plane; i < plane + num; i++) {
    const y = values[i], co = values[i + num], cg = values[i + 2 * num];
    values[i] = y - cg + co;
    values[i + num] = y + cg;
    values[i + 2 * num] = y - cg - co;
  }
}

const ROTATIONS = [-Math.SQRT1_2, Math.SQRT1_2]; // of what is not the largest
function packedRotation(q) {
  // As in compressed PLY: the index of the largest of w, x, y and z, then the others with 10 bits each.
  let largest = 0;
  for (let k = 1; k < 4; k++) if (Math.abs(q[k]) > Math.abs(q[largest])) largest = k;
  const scale = (q[largest] < 0 ? -1 : 1) / (Math.hypot(q[0], q[1], q[2], q[3]) || 1);
  let word = largest;
  for (let k = 0; k < 4; k++) if (k !== largest) word = word << 10 | quantised(q[k] * scale, ROTATIONS, 1023);
  return word;
}

const NEARLY_LINEAR = 1024; // quantisation steps of the file
function geometryOf({means: linear, rotations, log_scales: scales}, [keys, num], unit) {
  // Four words per Gaussian: 21 bits per axis of the mean over its bounds, the rotation, and 10 bits per log-scale.
  // Means beyond a unit are stored by their logarithms, so that distant Gaussians do not make near ones imprecise.
  const means = linear.map((x) => Math.sign(x) * Math.log1p(Math.abs(x) / unit));
  const words = new Uint32Array(4 * keys * num), implied = rotations.length < 4 * keys * num, q = [0, 0, 0, 0];
  const ranges = [0, 1, 2].map((axis) => boundsOf(axisOf(means, num, axis))), sizes = boundsOf(scales);
  for (let key = 0, out = 0; key < keys; key++) for (let i = 0; i < num; i++, out += 4) {
    const at = 3 * key * num + i; // of the first of three channels
    const y = quantised(means[at + num], ranges[1], 2097151);
    words[out] = quantised(means[at], ranges[0], 2097151) << 11 | y >>> 10;
    words[out + 1] = (y & 1023) << 21 | quantised(means[at + 2 * num], ranges[2], 2097151);
    for (let k = implied ? 1 : 0; k < 4; k++) q[k] = rotations[implied ? at + (k - 1) * num : (4 * key + k) * num + i];
    if (implied) q[0] = Math.sqrt(Math.max(0, 1 - q[1] ** 2 - q[2] ** 2 - q[3] ** 2));
    words[out + 2] = packedRotation(q);
    for (let k = 0; k < 3; k++) words[out + 3] = words[out + 3] << 10 | quantised(scales[at + k * num], sizes, 1023);
  }
  return {words, ranges, sizes};
}

function axisOf(values, num, axis) {
  const out = new Float32Array(values.length / 3);
  for (let k = 0; k * num < out.length; k++) out.set(values.subarray((3 * k + axis) * num, (3 * k + axis + 1) * num), k * num);
  return out;
}

function meansOf(means, [keys, num]) {
  // One Float32Array per key time, for the sorter.
  return Array.from({length: keys}, (_, key) => {
    const out = new Float32Array(3 * num);
    for (let i = 0; i < num; i++) for (let c = 0; c < 3; c++) out[3 * i + c] = means[(3 * key + c) * num + i];
    return out;
  });
}

function texelsOf(values, num, bounds, opacities = null) {
  // Texels (R, G, B, opacity), one layer per key time or coefficient.
  const layers = values.length / (3 * num) || 0, out = new Uint8Array(layers * num * 4);
  for (let k = 0; k < layers; k++) for (let i = 0; i < num; i++) {
    for (let c = 0; c < 3; c++) out[(k * num + i) * 4 + c] = quantised(values[(3 * k + c) * num + i], bounds, 255);
    if (opacities) out[(k * num + i) * 4 + 3] = quantised(opacities[k * num + i], [0, 1], 255);
  }
  return out;
}

// WebGL --------------------------------------------------------------------------------------------------------------

const canvas = element('canvas');
const gl = canvas.getContext('webgl2', {alpha: false, antialias: false, preserveDrawingBuffer: true})
  || fail('This page needs WebGL2, which this browser does not support or has disabled.');

function compiled() {
  const program = gl.createProgram();
  for (const [type, id] of [[gl.VERTEX_SHADER, 'vertex-shader'], [gl.FRAGMENT_SHADER, 'fragment-shader']]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, element(id).textContent.trim());
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) fail(`${id}: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, 'row');
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) fail(gl.getProgramInfoLog(program));
  return program;
}

const program = compiled();
const uniform = (name) => gl.getUniformLocation(program, name);
gl.useProgram(program);

function texture(unit, name, values, count, layers, isInteger) {
  const [internalFormat, format, type] = isInteger
    ? [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT] : [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE];
  const height = Math.max(1, Math.ceil(count / WIDTH));
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, gl.createTexture());
  gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, internalFormat, WIDTH, height, Math.max(1, layers));
  for (const end of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
    gl.texParameteri(gl.TEXTURE_2D_ARRAY, end, gl.NEAREST);
  }
  const whole = new values.constructor(WIDTH * height * 4);
  for (let layer = 0; layer < layers; layer++) {
    whole.set(values.subarray(layer * count * 4, (layer + 1) * count * 4));
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, WIDTH, height, 1, format, type, whole);
  }
  gl.uniform1i(uniform(name), unit);
}

async function upload() {
  const means = [];
  for (const [branch, name] of NAMES.entries()) {
    const {means: {shape, steps}, colors: {shape: [colorKeys]}, rest: {shape: [bases]}} = BRANCHES[branch], num = shape[1];
    const parts = {}, octaves = await integers(`${name}-octaves`, num);
    for (const part of Object.keys(BRANCHES[branch])) parts[part] = await unpacked(name, part, octaves);
    for (const part of ['colors', 'rest']) toColors(parts[part], num);
    const unit = NEARLY_LINEAR * steps[0], {words, ranges, sizes} = geometryOf(parts, shape, unit);
    const colors = boundsOf(parts.colors), rests = boundsOf(parts.rest);
    means.push(meansOf(parts.means, shape));
    texture(branch, `${name}Geometry`, words, num, shape[0], true);
    texture(2 + branch, `${name}Colors`, texelsOf(parts.colors, num, colors, parts.opacities), num, colorKeys, false);
    texture(4 + branch, `${name}Rest`, texelsOf(parts.rest, num, rests), num, bases, false);
    gl.uniform3fv(uniform(`lowest[${branch}]`), ranges.map((range) => range[0]));
    gl.uniform3fv(uniform(`span[${branch}]`), ranges.map((range) => range[1] - range[0]));
    gl.uniform1f(uniform(`unit[${branch}]`), unit);
    gl.uniform2fv(uniform(`sizes[${branch}]`), sizes);
    gl.uniform2fv(uniform(`colors[${branch}]`), colors);
    gl.uniform2fv(uniform(`rests[${branch}]`), rests);
    gl.uniform1i(uniform(`restBases[${branch}]`), bases);
  }
  gl.uniform1i(uniform('lastKey'), lastKey);
  gl.uniform1i(uniform('compensate'), START.antialias);
  gl.uniform1f(uniform('maxAlpha'), START.max_alpha);
  return means;
}

// Playback -----------------------------------------------------------------------------------------------------------

const state = {time: 0, playing: true, sorting: false, count: 0, changed: true};
const orbit = new Orbit(cameraOf(START.viewmat), START.pivot);
const track = START.track.map(cameraOf);
const numberOf = (value) => Number.isFinite(parseFloat(value)) ? Math.min(1, Math.max(0, parseFloat(value))) : 0;
element('follow-label').hidden = track.length === 0;

function applyAddress() { // e.g. #time=0.5&play=0&layers=dynamic
  const options = new URLSearchParams(location.hash.slice(1));
  const layers = NAMES.filter((name) => options.get('layers')?.includes(name));
  for (const name of NAMES) element(name).checked = !layers.length || layers.includes(name);
  state.time = numberOf(options.get('time'));
  state.playing = options.get('play') !== '0';
  state.changed = true;
  element('controls').hidden = options.get('controls') === '0';
  element('follow').checked = options.get('follow') !== '0' && track.length > 0;
}
applyAddress();
addEventListener('hashchange', applyAddress);

function currentCamera() {
  if (element('follow').checked) {
    const position = state.time * (track.length - 1), before = Math.min(Math.floor(position), track.length - 1);
    orbit.set(interpolated(track[before], track[Math.min(before + 1, track.length - 1)], position - before));
  }
  return orbit.camera;
}

function resized() {
  const width = Math.round(canvas.clientWidth * devicePixelRatio), height = Math.round(canvas.clientHeight * devicePixelRatio);
  if (canvas.width === width && canvas.height === height) return;
  canvas.width = width;
  canvas.height = height;
  state.changed = true;
}

function render(camera, position) {
  const [width, height] = START.size, [fx, fy, cx, cy] = START.intrinsics;
  const zoom = Math.min(canvas.width / width, canvas.height / height);
  const r = camera.rotation, t = r.map((row) => -dot(row, camera.position));
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(...START.background, 1);
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.uniform1f(uniforms.position, position);
  gl.uniform2f(uniforms.viewport, canvas.width, canvas.height);
  gl.uniform4f(uniforms.intrinsics, fx * zoom, fy * zoom,
    canvas.width / 2 + (cx - width / 2) * zoom, canvas.height / 2 + (cy - height / 2) * zoom);
  gl.uniformMatrix4fv(uniforms.view, false,
    [r[0][0], r[1][0], r[2][0], 0, r[0][1], r[1][1], r[2][1], 0, r[0][2], r[1][2], r[2][2], 0, ...t, 1]);
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, state.count);
}

const uniforms = Object.fromEntries(['position', 'viewport', 'intrinsics', 'view'].map((name) => [name, uniform(name)]));
const worker = new Worker(URL.createObjectURL(new Blob([element('sorter').textContent], {type: 'text/javascript'})));
worker.onerror = (event) => fail(`The sorter failed: ${event.message}`);
worker.onmessage = ({data}) => {
  gl.bufferData(gl.ARRAY_BUFFER, data.order, gl.DYNAMIC_DRAW);
  state.count = data.order.length;
  state.sorting = false;
  state.sorted = true;
  state.rendered = false;
  element('message').textContent = '';
};

let before = performance.now(), sortedFor = '';
document.addEventListener('visibilitychange', () => { before = performance.now(); }); // a hidden page is paused
function frame(now) {
  const elapsed = Math.max(0, now - before) / 1000; // slow machines skip times; playback keeps its speed
  before = now;
  if (state.playing && lastKey > 0) {
    state.time = (state.time + elapsed * Number(element('speed').value) / START.seconds) % 1;
    state.changed = true;
  }
  resized();
  if (state.changed || !state.rendered) {
    const camera = currentCamera(), position = state.time * lastKey, z = camera.rotation[2];
    const shown = NAMES.map((name) => element(name).checked), key = JSON.stringify([camera, position, shown]);
    if (!state.sorting && key !== sortedFor) {
      state.sorting = true;
      sortedFor = key;
      worker.postMessage({view: [...z, -dot(z, camera.position)], position, shown});
    }
    render(camera, position);
    state.changed = key !== sortedFor;
    state.rendered = true;
    if (state.sorted) document.body.dataset.state = state.sorting || state.changed ? 'playing' : 'settled';
    element('time').value = state.time;
    element('clock').textContent = `${(state.time * START.seconds).toFixed(2)} / ${START.seconds.toFixed(1)} s`;
    element('play').textContent = state.playing ? 'pause' : 'play';
    element('outside').hidden = !FILMED || outsideOf(FILMED, camera) <= 1;
  }
  requestAnimationFrame(frame);
}

// Controls -----------------------------------------------------------------------------------------------------------

const update = () => { state.changed = true; };
const toggle = () => { state.playing = !state.playing; update(); };
const home = () => { element('follow').checked = track.length > 0; orbit.reset(); update(); };
const moving = (move) => (right, down) => { // ends following the training camera
  element('follow').checked = false;
  if (FILMED) orbit.within(FILMED, move, right, down);
  else move(right, down);
  update();
};
const rotate = moving((right, down) => orbit.rotate(right, down)), pan = moving((right, down) => orbit.pan(right, down));
const zoomed = moving((steps) => orbit.zoom(Math.exp(steps))), zoom = (factor) => zoomed(Math.log(factor));
const pointers = new Map();
element('play').onclick = toggle;
element('home').onclick = home;
element('time').oninput = () => { state.playing = false; state.time = Number(element('time').value); update(); };
for (const id of [...NAMES, 'follow']) element(id).onchange = update;
canvas.oncontextmenu = (event) => event.preventDefault();
canvas.onpointerdown = (event) => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
};
canvas.onpointerup = canvas.onpointercancel = (event) => pointers.delete(event.pointerId);
canvas.onpointermove = (event) => {
  const last = pointers.get(event.pointerId);
  if (!last) return;
  const right = (event.clientX - last[0]) / canvas.clientHeight, down = (event.clientY - last[1]) / canvas.clientHeight;
  const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
  if (other) {
    const distance = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
    zoom(distance(last) / Math.max(1, distance([event.clientX, event.clientY])));
    pan(right / 2, down / 2);
  } else if (event.buttons & 2 || event.shiftKey) {
    pan(right, down);
  } else {
    rotate(3 * right, -3 * down);
  }
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
};
canvas.addEventListener('wheel', (event) => {
  event.preventDefault();
  zoom(Math.exp(event.deltaY / 800));
}, {passive: false});
// A control that was clicked does not keep the keys of the page. Those who move between controls by Tab keep the focus.
addEventListener('click', (event) => {
  if (event.detail && event.target.tagName !== 'SELECT') requestAnimationFrame(() => document.activeElement.blur());
});
element('speed').onchange = () => element('speed').blur();
addEventListener('keydown', (event) => {
  if (event.target !== document.body && event.target !== canvas) return;
  const step = lastKey > 0 ? 1 / lastKey : 0;
  if (event.key === ' ') toggle();
  else if (event.key === 'Home') home();
  else if (event.key === 'ArrowLeft' || event.key === 'ArrowRight') {
    state.playing = false;
    state.time = Math.min(1, Math.max(0, state.time + (event.key === 'ArrowLeft' ? -step : step)));
    update();
  } else return;
  event.preventDefault();
});
canvas.addEventListener('webglcontextlost', () => fail('The graphics context was lost; reload the page.'));

upload().then((means) => {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 4, 0);
  gl.vertexAttribDivisor(0, 1);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  worker.postMessage({means});
  requestAnimationFrame(frame);
}).catch((error) => fail(`The scene could not be shown: ${error.message}`));
