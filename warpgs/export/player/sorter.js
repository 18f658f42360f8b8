// Worker: sorts the Gaussians in front of the camera by depth, the farthest first.
// It receives {means: [static, dynamic]} once, then {view, position, shown}, and answers each with {order, position}.
'use strict';
const BUCKETS = 65536, DYNAMIC = 0x80000000, NEAR = 0.01;
let means, depths, rows;

function meanDepths(frames, position, view, first, bit) {
  // Depth of each mean between two key times; Gaussians behind the camera are omitted.
  const before = Math.min(Math.floor(position), frames.length - 1);
  const a = frames[before], b = frames[Math.min(before + 1, frames.length - 1)];
  const u = a === b ? 0 : position - before, v = 1 - u;
  const [x, y, z, w] = view;
  let count = first;
  for (let i = 0, k = 0; k < a.length; i++, k += 3) {
    const depth = x * (v * a[k] + u * b[k]) + y * (v * a[k + 1] + u * b[k + 1]) + z * (v * a[k + 2] + u * b[k + 2]) + w;
    if (depth > NEAR) {
      depths[count] = depth;
      rows[count++] = (i | bit) >>> 0;
    }
  }
  return count;
}

function sorted(count) {
  let nearest = Infinity, farthest = 0;
  for (let i = 0; i < count; i++) {
    nearest = Math.min(nearest, depths[i]);
    farthest = Math.max(farthest, depths[i]);
  }
  // Buckets are uniform in 1 / depth: finer close to the camera.
  const high = 1 / nearest, low = 1 / farthest, scale = high > low ? (BUCKETS - 1) / (high - low) : 0;
  const bucket = new Uint16Array(count), starts = new Uint32Array(BUCKETS + 1), order = new Uint32Array(count);
  for (let i = 0; i < count; i++) {
    bucket[i] = Math.max(0, 1 / depths[i] - low) * scale; // rounded down
    starts[bucket[i] + 1]++;
  }
  for (let k = 0; k < BUCKETS; k++) starts[k + 1] += starts[k];
  for (let i = 0; i < count; i++) order[starts[bucket[i]]++] = rows[i];
  return order;
}

onmessage = ({data}) => {
  if (data.means) {
    means = data.means;
    const total = means.reduce((sum, frames) => sum + frames[0].length / 3, 0);
    depths = new Float32Array(total);
    rows = new Uint32Array(total);
    return;
  }
  let count = 0;
  if (data.shown[0]) count = meanDepths(means[0], data.position, data.view, count, 0);
  if (data.shown[1]) count = meanDepths(means[1], data.position, data.view, count, DYNAMIC);
  const order = sorted(count);
  postMessage({order, position: data.position}, [order.buffer]);
};
