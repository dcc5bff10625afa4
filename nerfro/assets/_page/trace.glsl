#version 300 es
// Traces one ray through each pixel and integrates radiance along its path. The terms are those of
// samplers/paths/snell_cpu.py: a segment is the straight part of a path between two events, which are refractions or
// reflections at the surface of a body. Positions and lengths are in world units; directions are unit vectors.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler3D;
precision highp samplerCube;
precision highp isampler3D;
precision highp usampler3D;

// Camera. Pixels are counted from the upper left corner of the image; the axes are right, up and back (OpenGL).
uniform vec2 focal, principal, jitter;
// Pixels of this pass: every `stride`-th one in both directions, from `first` on; they fill the target from `corner` on.
uniform int stride;
uniform ivec2 first, corner;
uniform float height;
uniform mat3 axes;
uniform mat3 room;  // axes of the room in which the background stands still
uniform vec3 eye;
uniform float near;

// Bodies. Their signed distances are quadratic B-splines on grids that follow each other along z in one texture.
uniform isampler3D coefficients;
uniform ivec3 numVertices;  // of each body's grid
uniform vec3 gridLow[MAX_BODIES], gridHigh[MAX_BODIES];  // corners of each body's grid
uniform vec3 boxLow, boxHigh;  // corners of the box of all bodies
uniform float distanceUnit[MAX_BODIES];  // distance that one unit of the coefficients stands for
uniform usampler3D clearance;  // lower bound of the distance from each block of cells to the surface of the body
uniform float clearanceUnit[MAX_BODIES];  // distance that one unit of the clearance stands for
uniform float blockCells;  // cells per side of a block
uniform float minStep;  // shortest step of the search for a surface
uniform int numBodies, maxEvents;
uniform float wipe;  // column of the image, in pixels; rays of the pixels left of it are straight
uniform bool nested;  // whether a body exists only inside all previous bodies; a clear body of index 1 is then air
uniform int insideAtEye;  // bodies that contain the eye, one bit each
uniform float index[MAX_BODIES + 1];  // refractive index of air and of each body
uniform vec3 absorption[MAX_BODIES + 1];  // absorption coefficients of air and of each body, per world unit
uniform bool reflection;  // whether light splits at the first event (Fresnel); otherwise it is transmitted completely

// Radiance field: square root of the colour; in alpha, a linear function of the logarithm of the density, or 0 if empty.
uniform sampler3D volume;
uniform usampler3D occupied;  // whether each brick of the volume contains anything
uniform vec3 volumeLow, volumeHigh;
uniform vec2 logDensity;  // minimum and range
uniform float maxRadiance;  // radiance that the largest stored colour stands for
uniform float marchStep;  // length of a step through the volume
uniform float contractionRadius;  // radius around the centre of the volume beyond which space is contracted; 0 for none

// Background radiance: the cube map of the model, or a picture that the user has chosen.
uniform samplerCube sky;  // texels of equal angles, see backgrounds/cube_map.py
uniform sampler2D picture;  // lat-long, z up, +x in the middle
uniform bool skyIsPicture;

out vec4 colour;

int bodies;  // that bend the ray of this pixel

const int MAX_SEARCH_STEPS = 512;
const int MAX_SEGMENTS = 64;
const float FAR = 1e30;
// Distance between a surface and the start of the next segment, in cells. Closer to the surface, single precision may give
// the wrong side.
const float SURFACE_OFFSET = 2e-4;

// Returns the distances at which a line enters and leaves a box.
vec2 boxSpan(vec3 low, vec3 high, vec3 x, vec3 d) {
  vec3 inverse = 1.0 / mix(d, vec3(1e-20), equal(d, vec3(0.0)));
  vec3 toLow = (low - x) * inverse, toHigh = (high - x) * inverse;
  vec3 first = min(toLow, toHigh), last = max(toLow, toHigh);
  return vec2(max(first.x, max(first.y, first.z)), min(last.x, min(last.y, last.z)));
}

vec3 cellsPerUnit(int body) {
  return vec3(numVertices - 1) / (gridHigh[body] - gridLow[body]);
}

// Coefficients around the last position whose signed distance was computed. The search for a root takes most of its steps
// between the same coefficients.
ivec3 windowCorner = ivec3(-1);
mat3 window[3];  // by z, y and x

// Returns the gradient and value of the signed distance to a body; outside of its box a lower bound
// (media/distance_grid.py).
vec4 signedDistance(int body, vec3 x) {
  vec3 scale = cellsPerUnit(body);
  vec3 nearest = clamp(x, gridLow[body], gridHigh[body]);
  vec3 gridPosition = (nearest - gridLow[body]) * scale;
  ivec3 centre = clamp(ivec3(floor(gridPosition + 0.5)), ivec3(1), numVertices - 2);
  vec3 t = clamp(gridPosition - vec3(centre), -1.5, 1.5);
  // Weights and their slopes of three vertices along each axis.
  mat3 weight = transpose(mat3(0.5 * (0.5 - t) * (0.5 - t), 0.75 - t * t, 0.5 * (0.5 + t) * (0.5 + t)));
  mat3 slope = transpose(mat3(t - 0.5, -2.0 * t, t + 0.5));
  ivec3 corner = centre - 1 + ivec3(0, 0, body * numVertices.z);
  if (corner != windowCorner) {
    windowCorner = corner;
    for (int k = 0; k < 3; ++k) {
      for (int j = 0; j < 3; ++j) {
        for (int i = 0; i < 3; ++i) window[k][j][i] = float(texelFetch(coefficients, corner + ivec3(i, j, k), 0).r);
      }
    }
  }
  vec4 sum = vec4(0.0);
  for (int k = 0; k < 3; ++k) {
    vec3 lines = weight[0] * window[k];
    vec3 plane = vec3(dot(slope[0] * window[k], weight[1]), dot(lines, slope[1]), dot(lines, weight[1]));
    sum += vec4(plane.xy * weight[2][k], plane.z * vec2(slope[2][k], weight[2][k]));
  }
  vec4 phi = distanceUnit[body] * sum * vec4(scale, 1.0);
  float outside = distance(x, nearest);
  return outside > 0.0 && phi.w > 0.0 ? vec4(normalize(x - nearest), length(vec2(outside, phi.w))) : phi;
}

// Returns a lower bound of the distance to the surface of a body.
float clearanceOf(int body, vec3 x) {
  ivec3 blocks = textureSize(clearance, 0) / ivec3(1, 1, numBodies);
  vec3 nearest = clamp(x, gridLow[body], gridHigh[body]);
  ivec3 block = min(ivec3((nearest - gridLow[body]) * cellsPerUnit(body) / blockCells), blocks - 1);
  float units = float(texelFetch(clearance, block + ivec3(0, 0, body * blocks.z), 0).r);
  return length(vec2(distance(x, nearest), clearanceUnit[body] * units));
}

// Returns a lower bound of the distance to the surfaces of all bodies.
float clearanceAt(vec3 x) {
  float free = FAR;
  for (int body = 0; body < bodies; ++body) free = min(free, clearanceOf(body, x));
  return free;
}

// Returns the number of the body that decides at a point, from 1; 0 in air (media/bodies.py).
int decidingBody(int inside) {
  int number = 0;
  for (int body = 0; body < bodies; ++body) {
    if ((inside >> body & 1) == 1) number = body + 1;
    else if (nested) break;
  }
  return nested && index[number] == 1.0 && absorption[number] == vec3(0.0) ? 0 : number;
}

struct Hit {
  int body;  // body whose surface is hit; -1 for none
  float before, after;  // lengths just before and just behind the surface
  vec3 normal;
};

// Finds the first surface on a line. Sphere tracing advances to a change of sign; the Illinois method then shrinks the
// bracket around the root.
Hit firstSurface(vec3 x, vec3 d, int inside) {
  Hit hit = Hit(-1, 0.0, 0.0, vec3(0.0));
  vec2 span = boxSpan(boxLow, boxHigh, x, d);
  float t = max(span.x, 0.0), leave = span.y;
  if (bodies == 0 || t >= leave) return hit;
  float before = t, after = FAR, ownSide = 1.0, otherSide = 0.0;
  float tolerance = 1e-7 * (leave - t) + 2e-7 * t;
  for (int search = 0; search < MAX_SEARCH_STEPS; ++search) {
    vec3 p = x + t * d;
    if (hit.body < 0) {
      float free = clearanceAt(p);
      if (free > 2.0 * minStep) {
        before = t;
        ownSide = free;
        t += free;
        if (t >= leave) return hit;
        continue;
      }
    }
    // Signed distance to the nearest surface, positive on the side of the surface where the line begins.
    vec4 nearest = vec4(FAR);
    int body = 0;
    for (int b = 0; b < bodies; ++b) {
      float free = bodies > 1 ? clearanceOf(b, p) : 0.0;  // far from a body, the bound suffices
      vec4 phi = free > 2.0 * minStep ? vec4(free) : signedDistance(b, p) * ((inside >> b & 1) == 1 ? -1.0 : 1.0);
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
      t = min(t + max(nearest.w, minStep), leave);
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

// Returns the Fresnel reflectance for unpolarised light, given the cosines on both sides and n = n_after / n_before.
float fresnelReflectance(float cosine, float cosineAfter, float n) {
  float s = (cosine - n * cosineAfter) / (cosine + n * cosineAfter);
  float p = (n * cosine - cosineAfter) / (n * cosine + cosineAfter);
  return 0.5 * (s * s + p * p);
}

// Returns the scale of lengths under contraction (geometry/space.py).
float contractionScale(vec3 x) {
  vec3 offset = x - 0.5 * (volumeLow + volumeHigh);
  return contractionRadius > 0.0 ? min(contractionRadius * contractionRadius / dot(offset, offset), 1.0) : 1.0;
}

// Maps a position to contracted space.
vec3 contract(vec3 x) {
  vec3 middle = 0.5 * (volumeLow + volumeHigh);
  float share = sqrt(contractionScale(x));
  return middle + (2.0 - share) * share * (x - middle);
}

// Returns the number of steps of length `delta` to the end of an empty brick, at least 1. In contracted space, lines are
// curved, so the result is 1 there.
float stepsToBrickEnd(vec3 position, vec3 brick, vec3 bricks, vec3 x, vec3 d, float delta) {
  vec3 size = volumeHigh - volumeLow;
  vec3 walls = ((brick + vec3(greaterThan(d, vec3(0.0)))) / bricks - position) * size;
  vec3 ahead = mix(walls / d, vec3(FAR), lessThan(abs(d), vec3(1e-9)));
  float straight = contractionRadius > 0.0 ? contractionRadius - distance(x, 0.5 * (volumeLow + volumeHigh)) : FAR;
  return max(ceil(min(straight, min(ahead.x, min(ahead.y, ahead.z))) / delta), 1.0);
}

// Marches along a segment: adds the radiance of the volume, and multiplies the throughput by the transmittance of the
// volume and of the absorbing body.
void march(vec3 x, vec3 d, float start, float end, vec3 bodyAbsorption, inout vec3 throughput, inout vec3 radiance) {
  vec3 size = volumeHigh - volumeLow;
  vec2 span = boxSpan(volumeLow, volumeHigh, x, d);
  if (contractionRadius > 0.0) span = vec2(start, min(end, 1e4 * contractionRadius));
  float first = max(span.x, start), last = min(span.y, end);
  vec3 bricks = vec3(textureSize(occupied, 0)), texels = vec3(textureSize(volume, 0));
  vec3 lastBrick = vec3(-1.0);
  bool isEmpty = true;
  float transmittance = 1.0;
  if (first < last) {
    // A segment may touch only a corner of the volume. The lower bound keeps t + delta > t in single precision.
    float delta = max((last - first) / ceil((last - first) / marchStep), 1e-6 * last);
    // Steps have equal lengths in contracted space.
    for (float t = first + 0.5 * delta / contractionScale(x + first * d); t < last && transmittance > 1e-3;) {
      vec3 here = x + t * d;
      float scale = contractionScale(here);
      vec3 position = clamp((contract(here) - volumeLow) / size, 0.0, 0.999999);
      vec3 brick = floor(position * bricks);
      if (brick != lastBrick) isEmpty = texelFetch(occupied, ivec3(brick), 0).r == 0u;
      lastBrick = brick;
      if (isEmpty) {
        t += delta / scale * stepsToBrickEnd(position, brick, bricks, here, d, delta);
        continue;
      }
      vec4 stored = textureLod(volume, (position * (texels - 1.0) + 0.5) / texels, 0.0);
      if (stored.a > 0.5 / 255.0) {
        float stepTransmittance = exp(-delta * exp(logDensity.x + logDensity.y * stored.a));
        vec3 light = maxRadiance * stored.rgb * stored.rgb;
        radiance += throughput * exp(-bodyAbsorption * (t - start)) * transmittance * (1.0 - stepTransmittance) * light;
        transmittance *= stepTransmittance;
      }
      t += delta / scale;
    }
  }
  throughput *= transmittance * exp(-bodyAbsorption * (min(end, FAR) - start));
}

// Returns the background radiance from a direction of the world.
vec3 backgroundRadiance(vec3 direction) {
  vec3 d = direction * room;
  const float PI = 3.14159265358979;
  if (skyIsPicture) {
    return textureLod(picture, vec2(0.5 - atan(d.y, d.x) / (2.0 * PI), acos(clamp(d.z, -1.0, 1.0)) / PI), 0.0).rgb;
  }
  vec3 a = abs(d);
  return textureLod(sky, atan(d / max(a.x, max(a.y, a.z))) * (4.0 / PI), 0.0).rgb;
}

// Integrates radiance along the main path, then along the pending branch that is reflected at the first event, if any.
vec3 pathRadiance(vec3 x, vec3 d) {
  vec3 radiance = vec3(0.0), throughput = vec3(1.0);
  vec3 pendingPosition = vec3(0.0), pendingDirection = vec3(0.0), pendingThroughput = vec3(0.0);
  int inside = bodies == 0 ? 0 : insideAtEye, pendingInside = 0;
  float start = near;
  int numEvents = 0;
  for (int branch = 0; branch < 2; ++branch) {
    for (int segment = 0; segment < MAX_SEGMENTS; ++segment) {
      Hit hit = firstSurface(x, d, inside);
      int insideAfter = inside, bodyBefore = decidingBody(inside), bodyAfter = bodyBefore;
      if (hit.body >= 0) {
        insideAfter = inside ^ (1 << hit.body);
        bodyAfter = decidingBody(insideAfter);
        if (bodyAfter == 0 && bodyBefore > 0) {  // a gap of air thinner than the shortest step counts as closed
          vec3 behind = x + (hit.after + minStep) * d;
          int crossed = 0;
          for (int b = 0; b < bodies; ++b) {
            bool isInside = (insideAfter >> b & 1) == 1;
            if (b != hit.body && (signedDistance(b, behind).w < 0.0) != isInside) crossed |= 1 << b;
          }
          if (crossed != 0) hit.after += minStep;
          insideAfter ^= crossed;
          bodyAfter = decidingBody(insideAfter);
        }
      }
      float n = index[bodyAfter] / index[bodyBefore];
      bool isEvent = hit.body >= 0 && n != 1.0;
      bool isLast = hit.body < 0 || isEvent && numEvents >= maxEvents;
      march(x, d, start, isLast ? FAR : hit.after, isLast ? vec3(0.0) : absorption[bodyBefore], throughput, radiance);
      if (isLast) {
        radiance += throughput * backgroundRadiance(d);
        break;
      }
      vec3 normal = dot(hit.normal, d) > 0.0 ? -hit.normal : hit.normal;
      vec3 cells = cellsPerUnit(hit.body);
      vec3 offset = normal * SURFACE_OFFSET / min(cells.x, min(cells.y, cells.z));
      start = 0.0;
      if (!isEvent) {
        x += hit.after * d - offset;
        inside = insideAfter;
        continue;
      }
      ++numEvents;
      float cosine = -dot(normal, d);
      float squared = 1.0 - (1.0 - cosine * cosine) / (n * n);
      vec3 reflected = normalize(d + 2.0 * cosine * normal);
      if (squared <= 0.0) {
        x += hit.before * d + offset;
        d = reflected;
        continue;
      }
      if (reflection && branch == 0 && numEvents == 1) {
        float reflectance = fresnelReflectance(cosine, sqrt(squared), n);
        pendingPosition = x + hit.before * d + offset;
        pendingDirection = reflected;
        pendingInside = inside;
        pendingThroughput = reflectance * throughput;
        throughput *= 1.0 - reflectance;
      }
      x += hit.after * d - offset;
      d = normalize(d / n + (cosine / n - sqrt(squared)) * normal);
      inside = insideAfter;
    }
    if (pendingThroughput == vec3(0.0)) break;
    x = pendingPosition;
    d = pendingDirection;
    throughput = pendingThroughput;
    inside = pendingInside;
    numEvents = 1;
    start = 0.0;
  }
  return radiance;
}

void main() {
  vec2 centre = vec2(stride * (ivec2(gl_FragCoord.xy) - corner) + first) + 0.5;
  vec2 pixel = vec2(centre.x, height - centre.y) + jitter;
  bodies = centre.x < wipe ? 0 : numBodies;
  vec3 direction = vec3((pixel.x - principal.x) / focal.x, (principal.y - pixel.y) / focal.y, -1.0);
  // The largest half-precision number is 65504.
  colour = vec4(min(pathRadiance(eye, normalize(axes * direction)), 6e4), 1.0);
}
