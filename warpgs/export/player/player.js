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

// WebGL --------------------------------------------------------------------------------------------------------------

const canvas = element('canvas');
const gl = canvas.getContext('webgl2', {alpha: false, antialias: false, preserveDrawingBuffer: true})
  || fail('This page needs WebGL2, which this browser does not support or has disabled.');

function compiled(vertexId, fragmentId) {
  const program = gl.createProgram();
  for (const [type, id] of [[gl.VERTEX_SHADER, vertexId], [gl.FRAGMENT_SHADER, fragmentId]]) {
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

const program = compiled('vertex-shader', 'fragment-shader'), DOME_UNIT = 6; // after those of textures below
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

function applyAddress() {
  // Options after ? or #, e.g. ?autoplay=0&time=0.5&camera=0,0,-3,0,0,0 (position and target); those after # can change.
  const options = new URLSearchParams(`${location.search.slice(1)}&${location.hash.slice(1)}`);
  const option = (name) => options.getAll(name).pop();
  const layers = NAMES.filter((name) => option('layers')?.includes(name)), view = (option('camera') ?? '').split(',').map(Number);
  for (const name of NAMES) element(name).checked = !layers.length || layers.includes(name);
  state.time = numberOf(option('time'));
  state.playing = (option('autoplay') ?? option('play')) !== '0'; // "play" in links to pages of earlier versions
  state.changed = true;
  element('controls').hidden = option('controls') === '0';
  element('follow').checked = option('follow') !== '0' && track.length > 0;
  const position = view.slice(0, 3), target = view.slice(3);
  if (view.length !== 6 || !view.every(Number.isFinite) || String(position) === String(target)) return;
  element('follow').checked = false;
  orbit.look(position, target);
}
applyAddress();
addEventListener('hashchange', applyAddress);

function addressHere() {
  // The page's address at this time and view.
  const numbers = [...orbit.camera.position, ...orbit.pivot].map((v) => Number(v.toPrecision(6)));
  return `${location.href.split('#')[0]}#autoplay=${Number(state.playing)}&time=${state.time.toFixed(4)}&camera=${numbers}`;
}

function currentCamera() {
  if (element('follow').checked) {
    const position = state.time * (track.length - 1), before = Math.min(Math.floor(position), track.length - 1);
    orbit.set(interpolated(track[before], track[Math.min(before + 1, track.length - 1)], position - before));
  }
  return orbit.camera;
}

const MAX_RATIO = 2, SLOWEST = 1 / 30, FAST = 1 / 60, COARSEST = 0.4, REST = 0.25; // pixels per CSS pixel, [s], [s], of all, [s]
const pace = {part: 1, seconds: FAST, idle: Infinity};
function paced(seconds) {
  // The part of the pixels per axis to draw: fewer while images that change take longer than a thirtieth of a second.
  const rested = pace.idle > REST;
  pace.idle = state.changed ? 0 : pace.idle + seconds;
  if (pace.idle > REST) {
    if (!rested) Object.assign(pace, {part: Math.min(1, 1.25 * pace.part), seconds: FAST}); // tries more next time
    return 1;
  }
  pace.seconds = 0.9 * pace.seconds + 0.1 * Math.min(seconds, 0.1); // one late frame does not count
  if (pace.seconds > 1.1 * SLOWEST && pace.part > COARSEST) Object.assign(pace, {part: Math.max(COARSEST, 0.8 * pace.part), seconds: FAST});
  return pace.part;
}

function resized(part) {
  const ratio = part * Math.min(devicePixelRatio, MAX_RATIO);
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width === width && canvas.height === height) return;
  canvas.width = width;
  canvas.height = height;
  state.changed = true;
}

function draw({rotation: r, position}, [fx, fy, cx, cy], [left, bottom, width, height]) {
  // Draws the sorted Gaussians through a camera into a part of the framebuffer, from whose upper left corner cx, cy count.
  const t = r.map((row) => -dot(row, position));
  gl.viewport(left, bottom, width, height);
  drawDome({rotation: r}, [fx, fy, cx, cy], [left, bottom, width, height]);
  gl.uniform1f(uniforms.position, state.time * lastKey);
  gl.uniform2f(uniforms.viewport, width, height);
  gl.uniform4f(uniforms.intrinsics, fx, fy, cx, cy);
  gl.uniformMatrix4fv(uniforms.view, false,
    [r[0][0], r[1][0], r[2][0], 0, r[0][1], r[1][1], r[2][1], 0, r[0][2], r[1][2], r[2][2], 0, ...t, 1]);
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, state.count);
}

function render(camera) {
  const [width, height] = START.size, [fx, fy, cx, cy] = START.intrinsics;
  const zoom = Math.min(canvas.width / width, canvas.height / height);
  const center = [canvas.width / 2 + (cx - width / 2) * zoom, canvas.height / 2 + (cy - height / 2) * zoom];
  gl.clearColor(...START.background, 1);
  gl.clear(gl.COLOR_BUFFER_BIT);
  draw(camera, [fx * zoom, fy * zoom, ...center], [0, 0, canvas.width, canvas.height]);
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
function advance(now) {
  const elapsed = Math.max(0, now - before) / 1000; // slow machines skip times; playback keeps its speed
  before = now;
  if (state.playing && lastKey > 0) {
    state.time = (state.time + elapsed * Number(element('speed').value) / START.seconds) % 1;
    state.changed = true;
  }
  return elapsed;
}

function sortFor(camera) {
  // Asks for the order of the Gaussians at this time, unless it is known; returns whether it was asked for.
  const position = state.time * lastKey, z = camera.rotation[2], shown = NAMES.map((name) => element(name).checked);
  const key = JSON.stringify([camera, position, shown]);
  if (!state.sorting && key !== sortedFor) {
    state.sorting = true;
    sortedFor = key;
    worker.postMessage({view: [...z, -dot(z, camera.position)], position, shown});
  }
  return key === sortedFor;
}

function showTime() {
  element('time').value = state.time;
  element('clock').textContent = `${(state.time * START.seconds).toFixed(2)} / ${START.seconds.toFixed(1)} s`;
  element('play').textContent = state.playing ? 'pause' : 'play';
}

function frame(now) {
  const part = paced(advance(now));
  resized(part);
  if (state.changed || !state.rendered) {
    const camera = currentCamera();
    state.changed = !sortFor(camera);
    render(camera);
    state.rendered = true;
    if (state.sorted) document.body.dataset.state = state.sorting || state.changed || part < 1 ? 'playing' : 'settled';
    showTime();
    element('outside').hidden = !FILMED || outsideOf(FILMED, camera) <= 1;
  }
  state.request = requestAnimationFrame(frame);
}

const loaded = Promise.all([upload(), loadDome()]).then(([means]) => {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 4, 0);
  gl.vertexAttribDivisor(0, 1);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  worker.postMessage({means});
  state.request = requestAnimationFrame(frame);
}).catch((error) => fail(`The scene could not be shown: ${error.message}`));
