#version 300 es
// The radiance of one ray through each pixel: nerfro's paths (samplers/snell_cpu.py), and light along all their runs.
// Positions and lengths are in world units, directions have unit length.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler3D;
precision highp samplerCube;
precision highp isampler3D;
precision highp usampler3D;

// The camera: pixels are counted from the picture's upper left corner, axes are right, up and back (OpenGL).
uniform vec2 focal, principal, jitter;
uniform float height;
uniform mat3 axes;
uniform vec3 eye;
uniform float near;

// Bodies: the quadratic B-splines of their signed distances, one grid after another along z, each in its own box.
uniform isampler3D coefficients;
uniform ivec3 vertices;  // of one body's grid
uniform vec3 gridLow[MAX_BODIES], gridHigh[MAX_BODIES];
uniform vec3 allLow, allHigh;  // corners of the box of all bodies
uniform float distanceStep[MAX_BODIES];  // distance of one step of the coefficients
uniform usampler3D clearance;  // how far blocks of cells are from the body's surface, at least
uniform float clearanceStep[MAX_BODIES], blockCells;
uniform float shortestStep;
uniform int bodies, maxEvents;
uniform bool nested;  // whether a body is only where all before it are too; a clear one of index 1 is air then
uniform int startInside;  // bodies that the eye is in, a bit for each
uniform float index[MAX_BODIES + 1];  // of air and of each body
uniform vec3 absorption[MAX_BODIES + 1];  // for each world unit
uniform bool reflection;  // whether the first surface splits light (Fresnel), or the one transmitted path has it all

// What is in the volume: sqrt of colour, and the logarithm of density from 1 / 255 on.
uniform sampler3D volume;
uniform usampler3D occupied;  // whether a brick of the volume holds anything
uniform vec3 volumeLow, volumeHigh;
uniform vec2 logDensity;  // lowest, and range
uniform float brightest, marchStep;
uniform float ball;  // radius around the volume's middle beyond which space is contracted in it; 0 for none

uniform samplerCube sky;  // equal angles, see boundaries/cube_map.py
uniform sampler2D picture;  // lat-long, z up, +x in the middle
uniform bool skyIsPicture;

out vec4 colour;

const int MAX_SEARCH = 512;
const int MAX_RUNS = 64;
const float FAR = 1e30;
// Beyond an event, a ray begins so far from the surface on its side, in cells: single precision knows the side there.
const float ON_ITS_SIDE = 2e-4;

// Distances at which a line enters and leaves a box.
vec2 boxSpan(vec3 low, vec3 high, vec3 x, vec3 d) {
  vec3 inverse = 1.0 / mix(d, vec3(1e-20), equal(d, vec3(0.0)));
  vec3 toLow = (low - x) * inverse, toHigh = (high - x) * inverse;
  vec3 first = min(toLow, toHigh), last = max(toLow, toHigh);
  return vec2(max(first.x, max(first.y, first.z)), min(last.x, min(last.y, last.z)));
}

vec3 cellsPerUnit(int body) {
  return vec3(vertices - 1) / (gridHigh[body] - gridLow[body]);
}

// Gradient and value of one body's signed distance; outside of its box a lower bound (media/distance_grid.py).
vec4 signedDistance(int body, vec3 x) {
  vec3 scale = cellsPerUnit(body);
  vec3 nearest = clamp(x, gridLow[body], gridHigh[body]);
  vec3 place = (nearest - gridLow[body]) * scale;
  ivec3 centre = clamp(ivec3(floor(place + 0.5)), ivec3(1), vertices - 2);
  vec3 t = clamp(place - vec3(centre), -1.5, 1.5);
  vec3 weight[3] = vec3[3](0.5 * (0.5 - t) * (0.5 - t), 0.75 - t * t, 0.5 * (0.5 + t) * (0.5 + t));
  vec3 slope[3] = vec3[3](t - 0.5, -2.0 * t, t + 0.5);
  ivec3 corner = centre - 1 + ivec3(0, 0, body * vertices.z);
  vec4 sum = vec4(0.0);
  for (int k = 0; k < 3; ++k) {
    for (int j = 0; j < 3; ++j) {
      vec2 line = vec2(0.0);
      for (int i = 0; i < 3; ++i) {
        float c = float(texelFetch(coefficients, corner + ivec3(i, j, k), 0).r);
        line += c * vec2(slope[i].x, weight[i].x);
      }
      float wy = weight[j].y, wz = weight[k].z;
      sum += vec4(line.x * wy * wz, line.y * slope[j].y * wz, line.y * wy * slope[k].z, line.y * wy * wz);
    }
  }
  vec4 phi = distanceStep[body] * sum * vec4(scale, 1.0);
  float beyond = distance(x, nearest);
  return beyond > 0.0 && phi.w > 0.0 ? vec4(normalize(x - nearest), length(vec2(beyond, phi.w))) : phi;
}

float freeAround(vec3 x) {
  ivec3 blocks = textureSize(clearance, 0);
  blocks.z /= bodies;
  float free = FAR;
  for (int body = 0; body < bodies; ++body) {
    vec3 nearest = clamp(x, gridLow[body], gridHigh[body]);
    ivec3 block = min(ivec3((nearest - gridLow[body]) * cellsPerUnit(body) / blockCells), blocks - 1);
    float known = float(texelFetch(clearance, block + ivec3(0, 0, body * blocks.z), 0).r);
    free = min(free, length(vec2(distance(x, nearest), clearanceStep[body] * known)));
  }
  return free;
}

int innermost(int inside) {
  int number = 0;
  for (int body = 0; body < bodies; ++body) {
    if ((inside >> body & 1) == 1) number = body + 1;
    else if (nested) break;
  }
  return nested && index[number] == 1.0 && absorption[number] == vec3(0.0) ? 0 : number;
}

struct Hit {
  int body;  // -1 where no surface lies ahead
  float before, after;  // lengths on both sides of the surface
  vec3 normal;
};

// The first surface on a line. Sphere tracing ends in a change of sign; then the root is bracketed (Illinois method).
Hit surfaceAhead(vec3 x, vec3 d, int inside) {
  Hit hit = Hit(-1, 0.0, 0.0, vec3(0.0));
  vec2 span = boxSpan(allLow, allHigh, x, d);
  float t = max(span.x, 0.0), leave = span.y;
  if (bodies == 0 || t >= leave) return hit;
  float before = t, after = FAR, ownSide = 1.0, otherSide = 0.0;
  float tolerance = 1e-7 * (leave - t) + 2e-7 * t;
  for (int search = 0; search < MAX_SEARCH; ++search) {
    vec3 p = x + t * d;
    if (hit.body < 0) {
      float free = freeAround(p);
      if (free > 2.0 * shortestStep) {
        before = t;
        ownSide = free;
        t += free;
        if (t >= leave) return hit;
        continue;
      }
    }
    // The smallest distance to a surface, each body's positive on the ray's side of it.
    vec4 nearest = vec4(FAR);
    int body = 0;
    for (int b = 0; b < bodies; ++b) {
      vec4 phi = signedDistance(b, p) * ((inside >> b & 1) == 1 ? -1.0 : 1.0);
      if (phi.w < nearest.w) {
        nearest = phi;
        body = b;
      }
    }
    if (nearest.w < 0.0) {
      hit = Hit(body, before, t, nearest.xyz);
      after = t;
      otherSide = nearest.w;
      ownSide *= 0.5;
    } else {
      if (hit.body < 0 && t >= leave) return hit;
      before = t;
      ownSide = nearest.w;
      otherSide *= 0.5;
    }
    if (hit.body < 0) {
      t = min(t + max(nearest.w, shortestStep), leave);
      continue;
    }
    if (after - before <= tolerance) break;
    t = (before * otherSide - after * ownSide) / (otherSide - ownSide);
    bool within = t > before && t < after && search % 3 != 2;
    t = within ? t : 0.5 * (before + after);
    if (t <= before || t >= after) break;
  }
  hit.before = before;
  hit.normal = normalize(hit.normal);
  return hit;
}

// Share of unpolarised light that a surface reflects, for cosines on both sides and n = n_after / n_before.
float fresnel(float cosine, float cosineAfter, float n) {
  float s = (cosine - n * cosineAfter) / (cosine + n * cosineAfter);
  float p = (n * cosine - cosineAfter) / (n * cosine + cosineAfter);
  return 0.5 * (s * s + p * p);
}

// Share of a length that is left of it in the volume, and the place there (geometry/contraction.py).
float shrinkage(vec3 x) {
  vec3 offset = x - 0.5 * (volumeLow + volumeHigh);
  return ball > 0.0 ? min(ball * ball / dot(offset, offset), 1.0) : 1.0;
}

vec3 inVolume(vec3 x) {
  vec3 middle = 0.5 * (volumeLow + volumeHigh);
  float share = sqrt(shrinkage(x));
  return middle + (2.0 - share) * share * (x - middle);
}

// Steps of `delta` to the wall of an empty brick, at least one; none is skipped where lines are bent in the volume.
float stepsToWall(vec3 place, vec3 brick, vec3 bricks, vec3 x, vec3 d, float delta) {
  vec3 size = volumeHigh - volumeLow;
  vec3 walls = ((brick + vec3(greaterThan(d, vec3(0.0)))) / bricks - place) * size;
  vec3 ahead = mix(walls / d, vec3(FAR), lessThan(abs(d), vec3(1e-9)));
  float straight = ball > 0.0 ? ball - distance(x, 0.5 * (volumeLow + volumeHigh)) : FAR;
  return max(ceil(min(straight, min(ahead.x, min(ahead.y, ahead.z))) / delta), 1.0);
}

// Light of the volume on a straight run, and what the run leaves of the light behind it.
void march(vec3 x, vec3 d, float start, float end, vec3 absorbed, inout vec3 left, inout vec3 radiance) {
  vec3 size = volumeHigh - volumeLow;
  vec2 span = ball > 0.0 ? vec2(start, min(end, 1e4 * ball)) : boxSpan(volumeLow, volumeHigh, x, d);
  float first = max(span.x, start), last = min(span.y, end);
  vec3 bricks = vec3(textureSize(occupied, 0)), texels = vec3(textureSize(volume, 0));
  float transmittance = 1.0;
  if (first < last) {
    // Where a run only just enters the volume a step must still be one in single precision, or the loop never ends.
    float delta = max((last - first) / ceil((last - first) / marchStep), 1e-6 * last);
    // Steps are even in the volume, and wider in the world where it contracts space.
    for (float t = first + 0.5 * delta / shrinkage(x + first * d); t < last && transmittance > 1e-3;) {
      vec3 here = x + t * d;
      float smaller = shrinkage(here);
      vec3 place = clamp((inVolume(here) - volumeLow) / size, 0.0, 0.999999);
      vec3 brick = floor(place * bricks);
      if (texelFetch(occupied, ivec3(brick), 0).r == 0u) {
        t += delta / smaller * stepsToWall(place, brick, bricks, here, d, delta);
        continue;
      }
      vec4 stored = textureLod(volume, (place * (texels - 1.0) + 0.5) / texels, 0.0);
      if (stored.a > 0.5 / 255.0) {
        float passes = exp(-delta * exp(logDensity.x + logDensity.y * stored.a));
        vec3 light = brightest * stored.rgb * stored.rgb;
        radiance += left * exp(-absorbed * (t - start)) * transmittance * (1.0 - passes) * light;
        transmittance *= passes;
      }
      t += delta / smaller;
    }
  }
  left *= transmittance * exp(-absorbed * (min(end, FAR) - start));
}

vec3 fromSky(vec3 d) {
  const float PI = 3.14159265358979;
  if (skyIsPicture) {
    return textureLod(picture, vec2(0.5 - atan(d.y, d.x) / (2.0 * PI), acos(clamp(d.z, -1.0, 1.0)) / PI), 0.0).rgb;
  }
  vec3 a = abs(d);
  return textureLod(sky, atan(d / max(a.x, max(a.y, a.z))) * (4.0 / PI), 0.0).rgb;
}

// All light on a path, and on the one that the first surface splits from it.
vec3 radianceFrom(vec3 x, vec3 d) {
  vec3 radiance = vec3(0.0), left = vec3(1.0);
  vec3 splitFrom = vec3(0.0), splitTowards = vec3(0.0), splitLeft = vec3(0.0);
  int inside = startInside, splitInside = 0;
  float start = near;
  int events = 0;
  for (int branch = 0; branch < 2; ++branch) {
    for (int run = 0; run < MAX_RUNS; ++run) {
      Hit hit = surfaceAhead(x, d, inside);
      int flipped = inside, bodyBefore = innermost(inside), bodyAfter = bodyBefore;
      if (hit.body >= 0) {
        flipped = inside ^ (1 << hit.body);
        bodyAfter = innermost(flipped);
        if (bodyAfter == 0 && bodyBefore > 0) {  // a thin gap of air between bodies counts as closed
          vec3 behind = x + (hit.after + shortestStep) * d;
          int met = 0;
          for (int b = 0; b < bodies; ++b) {
            if (b != hit.body && (signedDistance(b, behind).w < 0.0) != ((flipped >> b & 1) == 1)) met |= 1 << b;
          }
          if (met != 0) hit.after += shortestStep;
          flipped ^= met;
          bodyAfter = innermost(flipped);
        }
      }
      float n = index[bodyAfter] / index[bodyBefore];
      bool bends = hit.body >= 0 && n != 1.0;
      bool ends = hit.body < 0 || bends && events >= maxEvents;
      march(x, d, start, ends ? FAR : hit.after, ends ? vec3(0.0) : absorption[bodyBefore], left, radiance);
      if (ends) {
        radiance += left * fromSky(d);
        break;
      }
      vec3 normal = dot(hit.normal, d) > 0.0 ? -hit.normal : hit.normal;
      vec3 cells = cellsPerUnit(hit.body);
      vec3 apart = normal * ON_ITS_SIDE / min(cells.x, min(cells.y, cells.z));
      start = 0.0;
      if (!bends) {
        x += hit.after * d - apart;
        inside = flipped;
        continue;
      }
      ++events;
      float cosine = -dot(normal, d);
      float squared = 1.0 - (1.0 - cosine * cosine) / (n * n);
      vec3 mirrored = normalize(d + 2.0 * cosine * normal);
      if (squared <= 0.0) {
        x += hit.before * d + apart;
        d = mirrored;
        continue;
      }
      if (reflection && branch == 0 && events == 1) {
        float share = fresnel(cosine, sqrt(squared), n);
        splitFrom = x + hit.before * d + apart;
        splitTowards = mirrored;
        splitInside = inside;
        splitLeft = share * left;
        left *= 1.0 - share;
      }
      x += hit.after * d - apart;
      d = normalize(d / n + (cosine / n - sqrt(squared)) * normal);
      inside = flipped;
    }
    if (splitLeft == vec3(0.0)) break;
    x = splitFrom;
    d = splitTowards;
    left = splitLeft;
    inside = splitInside;
    events = 1;
    start = 0.0;
  }
  return radiance;
}

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, height - gl_FragCoord.y) + jitter;
  vec3 direction = vec3((pixel.x - principal.x) / focal.x, (principal.y - pixel.y) / focal.y, -1.0);
  // Half floats end at 65504.
  colour = vec4(min(radianceFrom(eye, normalize(axes * direction)), 6e4), 1.0);
}
