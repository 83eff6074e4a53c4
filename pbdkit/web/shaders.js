/** How vertices are placed and coloured. */

export const VERTEX = `#version 300 es
layout(location = 0) in vec2 place;
layout(location = 1) in float level;
layout(location = 2) in float kind;
layout(location = 3) in float beyond;
uniform vec4 screen;
uniform float size;
uniform vec3 kinds[3];
out float tone;
out float gap;
out float outside;
flat out vec3 paint;
void main() {
  gl_Position = vec4(place * screen.xy + screen.zw, 0.0, 1.0);
  gl_PointSize = size;
  tone = level;
  gap = level < 0.0 ? 1.0 : 0.0;
  outside = beyond;
  paint = kinds[int(kind)];
}`;

export const FRAGMENT = `#version 300 es
precision highp float;
in float tone;
in float gap;
in float outside;
flat in vec3 paint;
uniform float size;
uniform int look;   // 0 one colour, 1 kinds, 2 values
uniform int shape;  // 0 lines and squares, 1 discs, 2 rings, 3 triangles
uniform vec4 one;
uniform vec3 unknown;
uniform sampler2D map;
out vec4 colour;
void main() {
  if (shape == 3 && gap > 0.0) discard;
  if (outside > 0.0 && (shape == 3 || (look == 0 && shape == 1))) discard; // fields, and dots on them
  colour = one;
  if (look == 1) colour = vec4(paint, 1.0);
  if (look == 2) colour = vec4(gap > 0.0 ? unknown : texture(map, vec2(tone, 0.5)).rgb, 1.0);
  if (shape == 1 || shape == 2) {
    float inside = 0.5 * size - length(gl_PointCoord - 0.5) * size;
    float width = clamp(0.1 * size, 0.0, 1.6);
    if (shape == 1 && size > 6.0) {
      colour.rgb = mix(colour.rgb * 0.45, colour.rgb, clamp(inside - width + 0.5, 0.0, 1.0));
    }
    if (shape == 2) { // a dark ring between two white ones, seen on dark and on white
      colour.rgb = mix(colour.rgb, vec3(1.0), clamp(abs(inside - 3.0) - 0.8, 0.0, 1.0));
      colour.a *= clamp(6.0 - inside, 0.0, 1.0);
    }
    colour.a *= clamp(inside, 0.0, 1.0);
  }
}`;

export const UNIFORMS = ["screen", "size", "kinds", "look", "shape", "one", "unknown", "map"];
