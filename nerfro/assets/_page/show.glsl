#version 300 es
// Mean radiance of the rays of each pixel, encoded and clipped once.
precision highp float;
precision highp sampler2D;

uniform sampler2D traced;
uniform vec2 size;  // of the canvas, pixels
uniform bool linear;  // whether light was added up as linear radiance, or as sRGB

out vec4 colour;

void main() {
  vec3 light = textureLod(traced, gl_FragCoord.xy / size, 0.0).rgb;
  vec3 bright = 1.055 * pow(max(light, 0.0031308), vec3(1.0 / 2.4)) - 0.055;
  vec3 encoded = mix(bright, 12.92 * light, lessThanEqual(light, vec3(0.0031308)));
  colour = vec4(clamp(linear ? encoded : light, 0.0, 1.0), 1.0);
}
