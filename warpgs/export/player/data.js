// The scene of the page: restored from quantised coefficients, and packed for the GPU and the sorter.
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
