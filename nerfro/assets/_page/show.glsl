#version 300 es
// Encodes the mean radiance of the rays of each pixel as sRGB and clips it.
precision highp float;
precision highp sampler2D;

uniform sampler2D traced;
uniform vec2 size;  // of the canvas, pixels
uniform bool linear;  // whether the traced radiance is linear; otherwise it is sRGB

out vec4 colour;

void main() {
  vec3 radiance = textureLod(traced, gl_FragCoord.xy / size, 0.0).rgb;
  vec3 bright = 1.055 * pow(max(radiance, 0.0031308), vec3(1.0 / 2.4)) - 0.055;
  vec3 encoded = mix(bright, 12.92 * radiance, lessThanEqual(radiance, vec3(0.0031308)));
  colour = vec4(clamp(linear ? encoded : radiance, 0.0, 1.0), 1.0);
}
