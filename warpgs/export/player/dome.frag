#version 300 es
// The sky: an equirectangular image around the world's z axis, with the formulas of warpgs/model/dome.py.
precision highp float;
uniform sampler2D sky;
uniform mat3 toWorld;
uniform vec4 intrinsics;   // fx, fy, cx, cy [px]
uniform vec2 corner;       // upper left corner of the part of the framebuffer [px]
out vec4 shown;

const float PI = 3.14159265359;

void main() {
  vec2 pixel = vec2(gl_FragCoord.x - corner.x, corner.y - gl_FragCoord.y);
  vec3 d = toWorld * vec3((pixel - intrinsics.zw) / intrinsics.xy, 1.0);
  shown = vec4(texture(sky, vec2(atan(d.y, d.x) / (2.0 * PI), 0.5 - atan(d.z, length(d.xy)) / PI)).rgb, 1.0);
}
