#version 300 es
precision highp float;
in vec2 offset;
flat in vec4 color;
uniform float maxAlpha;
out vec4 shown;

void main() {
  float alpha = min(maxAlpha, color.a * exp(-0.5 * dot(offset, offset)));
  if (alpha < 1.0 / 255.0) discard;
  shown = vec4(color.rgb * alpha, alpha);
}
