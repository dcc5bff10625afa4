#version 300 es
// Encodes the mean radiance of the rays of each pixel as sRGB and clips it.
precision highp float;
precision highp int;
precision highp sampler2D;

uniform sampler2D draft;  // small image of the view, while no pass is complete
uniform sampler2D traced;  // passes side by side, see Tracer.trace
uniform ivec2 size;  // of the canvas, pixels
uniform int stride;  // a pass has every `stride`-th pixel
uniform int done;  // complete passes
uniform int order[16];  // number of the pass of each pixel in a block of 4x4
uniform bool linear;  // whether the traced radiance is linear; otherwise it is sRGB

out vec4 colour;

vec3 radianceAt(ivec2 pixel) {
  return texelFetch(traced, pixel % stride * ((size + stride - 1) / stride) + pixel / stride, 0).rgb;
}

// Interpolates between the pixels of complete passes, which are `spacing` pixels apart.
vec3 interpolated(ivec2 pixel, int spacing) {
  ivec2 low = pixel / spacing * spacing, high = min(low + spacing, (size - 1) / spacing * spacing);
  vec2 share = vec2(pixel - low) / float(spacing);
  vec3 below = mix(radianceAt(low), radianceAt(ivec2(high.x, low.y)), share.x);
  return mix(below, mix(radianceAt(ivec2(low.x, high.y)), radianceAt(high), share.x), share.y);
}

vec3 radianceOf(ivec2 pixel) {
  if (done == 0) return textureLod(draft, gl_FragCoord.xy / vec2(size), 0.0).rgb;
  ivec2 inBlock = pixel % 4;
  if (stride == 1 || order[4 * inBlock.y + inBlock.x] < done) return radianceAt(pixel);
  return interpolated(pixel, done < 4 ? 4 : 2);
}

void main() {
  vec3 radiance = radianceOf(ivec2(gl_FragCoord.xy));
  vec3 bright = 1.055 * pow(max(radiance, 0.0031308), vec3(1.0 / 2.4)) - 0.055;
  vec3 encoded = mix(bright, 12.92 * radiance, lessThanEqual(radiance, vec3(0.0031308)));
  colour = vec4(clamp(linear ? encoded : radiance, 0.0, 1.0), 1.0);
}
