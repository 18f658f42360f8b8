#version 300 es
// Renders a Gaussian as a quad on the screen (EWA projection, with the formulas of warpgs/kernels/projection.py).
precision highp float;
precision highp int;
precision highp usampler2DArray;
precision highp sampler2DArray;

uniform usampler2DArray staticGeometry, dynamicGeometry; // one layer per key time
uniform sampler2DArray staticColors, dynamicColors;      // one layer per key time
uniform sampler2DArray staticRest, dynamicRest;          // one layer per coefficient
uniform vec3 lowest[2], span[2];                         // bounds of the stored means; [0] static, [1] dynamic
uniform float unit[2];                                   // beyond it, means are stored by their logarithms
uniform vec2 sizes[2], colors[2], rests[2];              // minimum and maximum
uniform int restBases[2];
uniform float position;    // time in keys
uniform int lastKey;
uniform mat4 view;         // world to camera, OpenCV axes
uniform vec4 intrinsics;   // fx, fy, cx, cy [px]
uniform vec2 viewport;     // [px]
uniform bool compensate;

in uint row;               // the highest bit marks dynamic Gaussians

out vec2 offset;           // from the centre, in standard deviations
flat out vec4 color;

const float LOW_PASS = 0.3, NEAR = 0.01, MARGIN = 0.3, WIDTH = 11.0;

vec4 rotation(uint word) {
  vec3 others = (vec3(uvec3(word >> 20, word >> 10, word) & 1023u) / 1023.0 * 2.0 - 1.0) * sqrt(0.5);
  float largest = sqrt(max(0.0, 1.0 - dot(others, others)));
  switch (word >> 30) {
    case 0u: return vec4(largest, others);
    case 1u: return vec4(others.x, largest, others.yz);
    case 2u: return vec4(others.xy, largest, others.z);
    default: return vec4(others, largest);
  }
}

mat3 matrixOf(vec4 q) { // q = (w, x, y, z)
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec3 mean(uvec4 words, int branch) {
  uint y = ((words.x & 2047u) << 10) | (words.y >> 21);
  vec3 stored = lowest[branch] + vec3(words.x >> 11, y, words.y & 2097151u) / 2097151.0 * span[branch];
  return sign(stored) * (exp(abs(stored)) - 1.0) * unit[branch];
}

vec3 logScales(uint word, int branch) {
  return mix(vec3(sizes[branch].x), vec3(sizes[branch].y), vec3(uvec3(word >> 20, word >> 10, word) & 1023u) / 1023.0);
}

vec3 rest(ivec2 texel, int k, int branch) {
  vec3 value = (branch == 1 ? texelFetch(dynamicRest, ivec3(texel, k), 0) : texelFetch(staticRest, ivec3(texel, k), 0)).rgb;
  return mix(vec3(rests[branch].x), vec3(rests[branch].y), value);
}

// Spherical harmonics of degrees 1 to 3 in direction d, times their coefficients.
vec3 viewDependent(ivec2 texel, vec3 d, int branch) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  float bases[15] = float[15](
    -0.4886025119 * y, 0.4886025119 * z, -0.4886025119 * x,
    1.0925484306 * x * y, -1.0925484306 * y * z, 0.3153915653 * (2.0 * zz - xx - yy), -1.0925484306 * x * z,
    0.5462742153 * (xx - yy),
    -0.5900435899 * y * (3.0 * xx - yy), 2.8906114426 * x * y * z, -0.4570457995 * y * (4.0 * zz - xx - yy),
    0.3731763326 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -0.4570457995 * x * (4.0 * zz - xx - yy),
    1.4453057213 * z * (xx - yy), -0.5900435899 * x * (xx - 3.0 * yy));
  vec3 sum = vec3(0.0);
  for (int k = 0; k < restBases[branch]; k++) sum += bases[k] * rest(texel, k, branch);
  return sum;
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside of the image until the Gaussian is known to be visible
  int branch = int(row >> 31), index = int(row & 0x7fffffffu);
  ivec2 texel = ivec2(index & 2047, index >> int(WIDTH));
  int before = min(int(position), lastKey), after = min(before + 1, lastKey);
  float fraction = position - float(before);

  vec3 world, scales;
  vec4 quat, shade;
  if (branch == 1) {
    uvec4 a = texelFetch(dynamicGeometry, ivec3(texel, before), 0);
    uvec4 b = texelFetch(dynamicGeometry, ivec3(texel, after), 0);
    vec4 qa = rotation(a.z), qb = rotation(b.z);
    world = mix(mean(a, 1), mean(b, 1), fraction);
    quat = normalize(mix(qa, dot(qa, qb) < 0.0 ? -qb : qb, fraction));
    scales = exp(mix(logScales(a.w, 1), logScales(b.w, 1), fraction));
    int last = textureSize(dynamicColors, 0).z - 1; // 0 unless opacities change
    vec4 next = texelFetch(dynamicColors, ivec3(texel, min(after, last)), 0);
    shade = mix(texelFetch(dynamicColors, ivec3(texel, min(before, last)), 0), next, fraction);
  } else {
    uvec4 a = texelFetch(staticGeometry, ivec3(texel, 0), 0);
    world = mean(a, 0);
    quat = rotation(a.z);
    scales = exp(logScales(a.w, 0));
    shade = mix(texelFetch(staticColors, ivec3(texel, before), 0), texelFetch(staticColors, ivec3(texel, after), 0), fraction);
  }

  vec3 t = (view * vec4(world, 1.0)).xyz;
  if (!(t.z > NEAR)) return;
  vec2 focal = intrinsics.xy, center = intrinsics.zw, slope = t.xy / t.z;
  vec2 margin = MARGIN * 0.5 * viewport / focal;
  vec2 kept = clamp(slope, -center / focal - margin, (viewport - center) / focal + margin);
  mat3 toCamera = mat3(view);
  mat3 spread = toCamera * matrixOf(quat) * mat3(scales.x, 0.0, 0.0, 0.0, scales.y, 0.0, 0.0, 0.0, scales.z);
  vec3 alongX = focal.x / t.z * (vec3(spread[0].x, spread[1].x, spread[2].x) - kept.x * vec3(spread[0].z, spread[1].z, spread[2].z));
  vec3 alongY = focal.y / t.z * (vec3(spread[0].y, spread[1].y, spread[2].y) - kept.y * vec3(spread[0].z, spread[1].z, spread[2].z));
  float a = dot(alongX, alongX), b = dot(alongX, alongY), c = dot(alongY, alongY);
  vec3 normal = cross(alongX, alongY);
  float sharp = dot(normal, normal);
  float blurred = sharp + LOW_PASS * (a + c + LOW_PASS);
  float opacity = shade.a * (compensate ? sqrt(sharp / blurred) : 1.0);
  a += LOW_PASS;
  c += LOW_PASS;
  if (!(opacity >= 1.0 / 255.0)) return;

  float middle = 0.5 * (a + c), radius = length(vec2(0.5 * (a - c), b));
  float longest = middle + radius, shortest = max(middle - radius, 0.1);
  vec2 axis = radius < 1e-6 ? vec2(1.0, 0.0) : normalize(abs(a - c) > abs(b) || a > c ? vec2(longest - c, b) : vec2(b, longest - a));
  float reach = sqrt(2.0 * log(255.0 * opacity));
  vec2 corner = vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID >> 1) * 2 - 1) * reach;
  vec2 pixel = focal * slope + center + corner.x * sqrt(longest) * axis + corner.y * sqrt(shortest) * vec2(-axis.y, axis.x);

  vec3 origin = -transpose(toCamera) * view[3].xyz;
  vec3 own = mix(vec3(colors[branch].x), vec3(colors[branch].y), shade.rgb);
  color = vec4(max(own + viewDependent(texel, normalize(world - origin), branch), 0.0), opacity);
  offset = corner;
  gl_Position = vec4(2.0 * pixel.x / viewport.x - 1.0, 1.0 - 2.0 * pixel.y / viewport.y, 0.0, 1.0);
}
