// WebGL2: the textures of a scene, the program that traces it, and the program that shows the result.

// Textures of the tracing program, in the order of their texture units.
const UNITS = ["coefficients", "clearance", "volume", "occupied", "sky", "picture"];

// First pixel of each interleaved pass over blocks of 4x4 pixels. The first four passes have every second pixel.
const PASSES = [0, 10, 2, 8, 5, 15, 7, 13, 4, 14, 6, 12, 1, 11, 3, 9].map((at) => [at % 4, at >> 2]);
const ORDER = PASSES.map((_, at) => PASSES.findIndex(([x, y]) => 4 * y + x === at));

class Tracer {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!gl) throw new Error("This page needs WebGL2, which this browser does not have or has switched off.");
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) {
      throw new Error("This page needs to draw into textures of half floats, which this graphics driver does not allow.");
    }
    this.gl = gl;
    this.canvas = canvas;
    this.textures = {};
    const target = () => ({ texture: gl.createTexture(), buffer: gl.createFramebuffer(), size: [0, 0] });
    this.targets = { draft: target(), traced: target() };
    this.shown = { stride: 1, done: 0 };
    gl.bindVertexArray(gl.createVertexArray());
  }

  // Upload the arrays of a scene to textures; `images` are the arrays as decoded images, by name.
  load(scene, images) {
    const gl = this.gl;
    const { surface, volume, sky } = scene;
    if (!this.programs || this.scene.surface.iors.length !== surface.iors.length) {
      const bodies = Math.max(surface.iors.length, 1);
      this.programs = {
        trace: this.program(source("trace").replaceAll("MAX_BODIES", bodies)),
        show: this.program(source("show")),
      };
    }
    this.scene = scene;
    if (surface.iors.length) {
      const distances = signedIntegers(unpackVoxels(images.distances, surface.gridSize));
      this.texture3D("coefficients", gl.R16I, gl.RED_INTEGER, gl.SHORT, surface.gridSize, distances);
      const clearance = redChannel(unpackVoxels(images.clearance, surface.clearanceSize));
      this.texture3D("clearance", gl.R8UI, gl.RED_INTEGER, gl.UNSIGNED_BYTE, surface.clearanceSize, clearance);
      this.distances = distances;
    } else {
      this.texture3D("coefficients", gl.R16I, gl.RED_INTEGER, gl.SHORT, [1, 1, 1], new Int16Array(1));
      this.texture3D("clearance", gl.R8UI, gl.RED_INTEGER, gl.UNSIGNED_BYTE, [1, 1, 1], new Uint8Array(1));
    }
    const content = withAlpha(unpackVoxels(images.colour, volume.size), unpackVoxels(images.density, volume.size));
    this.texture3D("volume", gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, volume.size, content, gl.LINEAR);
    const occupied = redChannel(unpackVoxels(images.occupied, volume.occupiedSize));
    this.texture3D("occupied", gl.R8UI, gl.RED_INTEGER, gl.UNSIGNED_BYTE, volume.occupiedSize, occupied);
    const faces = sharedExponent(
      unpackVoxels(images.sky, [sky.size, sky.size, 6]), unpackVoxels(images.sky_exponent, [sky.size, sky.size, 6]));
    this.bind("sky", gl.TEXTURE_CUBE_MAP, gl.LINEAR);
    for (let face = 0; face < 6; ++face) {
      gl.texImage2D(
        gl.TEXTURE_CUBE_MAP_POSITIVE_X + face, 0, gl.RGB9_E5, sky.size, sky.size, 0, gl.RGB,
        gl.UNSIGNED_INT_5_9_9_9_REV, faces, face * sky.size ** 2);
    }
    if (!this.textures.picture) this.setPicture(null);
  }

  // Replace the sky by a lat-long picture (an image, or radiance from `decodeHdr`); null restores the sky of the scene.
  setPicture(picture) {
    const gl = this.gl;
    this.skyIsPicture = picture !== null;
    this.bind("picture", gl.TEXTURE_2D, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.REPEAT);
    if (picture === null) {
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    } else if (picture.pixels) {
      const { width, height, pixels } = picture;
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.FLOAT, pixels);
    } else {
      const format = this.scene.linear ? gl.SRGB8_ALPHA8 : gl.RGBA8; // SRGB8_ALPHA8 textures are decoded to linear values
      gl.texImage2D(gl.TEXTURE_2D, 0, format, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    }
  }

  // Trace one ray through each pixel of a pass, at the offset `jitter` from its centre, and blend the result with the
  // previous rays by `weight`. Pass number `pass` has every `stride`-th pixel in both directions, so that `stride` squared
  // passes have all of them; `rows` limits it to rows from the first number to before the second. The passes are side by
  // side in the target. See camera.js for views; the resolution of the traced image may differ from `view.size`.
  trace(view, settings, [width, height], { target = "traced", stride = 1, pass = 0, rows, jitter = [0, 0], weight = 1 } = {}) {
    const gl = this.gl;
    const size = [width, height].map((side) => Math.ceil(side / stride));
    const [low, high] = rows ?? [0, size[1]];
    this.resize(this.targets[target], size.map((side) => side * stride));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets[target].buffer);
    const first = PASSES[pass];
    const corner = first.map((at, axis) => at * size[axis]);
    gl.viewport(corner[0], corner[1] + low, size[0], high - low);
    gl.useProgram(this.programs.trace.program);
    UNITS.forEach((name, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(this.textures[name].target, this.textures[name].texture);
    });
    const scale = [width / view.size[0], height / view.size[1]];
    const { surface, volume } = this.scene;
    const numBodies = surface.iors.length;
    this.setUniforms("trace", {
      focal: [view.focal[0] * scale[0], view.focal[1] * scale[1]],
      principal: [view.principal[0] * scale[0], view.principal[1] * scale[1]],
      jitter, stride, first, corner, height, axes: view.axes, eye: view.eye, near: view.near,
      room: roomAxes(view.axes, this.scene.turntable),
      numVertices: surface.numVertices, gridLow: surface.low.flat(), gridHigh: surface.high.flat(),
      boxLow: alongAxes(Math.min, surface.low), boxHigh: alongAxes(Math.max, surface.high),
      distanceUnit: surface.distanceUnits, clearanceUnit: surface.clearanceUnits, blockCells: surface.blockCells,
      minStep: surface.minStep, numBodies, wipe: settings.straight * width, nested: surface.nested, maxEvents: surface.maxEvents,
      insideAtEye: numBodies ? this.bodiesAt(view.eye) : 0,
      absorption: [0, 0, 0, ...settings.absorption.flat()],
      reflection: settings.reflection,
      volumeLow: volume.low, volumeHigh: volume.high, logDensity: volume.logDensity, maxRadiance: volume.maxRadiance,
      marchStep: volume.marchStep, contractionRadius: volume.contractionRadius, skyIsPicture: this.skyIsPicture,
    });
    gl.enable(gl.BLEND);
    gl.blendColor(0, 0, 0, weight);
    gl.blendFunc(gl.CONSTANT_ALPHA, gl.ONE_MINUS_CONSTANT_ALPHA);
    // If a body disperses, each colour channel is traced with its own indices; otherwise (-1) all channels at once.
    const channels = surface.dispersion.flat().some((change) => change !== 0) ? [0, 1, 2] : [-1];
    for (const channel of channels) {
      const indexOf = (ior, body) => ior + (channel < 0 ? 0 : (ior - 1) * surface.dispersion[body][channel]);
      this.setUniforms("trace", { index: [1, ...settings.iors.map(indexOf)] });
      if (channel >= 0) gl.colorMask(channel === 0, channel === 1, channel === 2, channel === 2);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    gl.colorMask(true, true, true, true);
    gl.disable(gl.BLEND);
  }

  // Show the passes that are complete, number `done`, on the canvas, or before the first pass the small image of the view.
  show(shown = this.shown) {
    const gl = this.gl;
    this.shown = shown;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.useProgram(this.programs.show.program);
    Object.values(this.targets).forEach(({ texture }, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    this.setUniforms("show", {
      draft: 0, traced: 1, size: [this.canvas.width, this.canvas.height], ...shown, order: ORDER, linear: this.scene.linear,
    });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Return the bodies that contain a position, one bit each, from the signed distances at the nearest grid vertex.
  bodiesAt(position) {
    const { numVertices, low, high, iors } = this.scene.surface;
    const [nx, ny, nz] = numVertices;
    return iors.reduce((bits, _, b) => {
      const vertex = position.map((x, axis) =>
        Math.round(((x - low[b][axis]) / (high[b][axis] - low[b][axis])) * (numVertices[axis] - 1)));
      if (vertex.some((i, axis) => i < 0 || i >= numVertices[axis])) return bits;
      return bits | ((this.distances[((b * nz + vertex[2]) * ny + vertex[1]) * nx + vertex[0]] < 0) << b);
    }, 0);
  }

  resize(target, [width, height]) {
    if (target.size[0] === width && target.size[1] === height) return;
    const gl = this.gl;
    target.size = [width, height];
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, target.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    this.filter(gl.TEXTURE_2D, gl.LINEAR);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target.texture, 0);
  }

  bind(name, target, filter) {
    const gl = this.gl;
    this.textures[name] ??= { target, texture: gl.createTexture() };
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(target, this.textures[name].texture);
    this.filter(target, filter);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  }

  filter(target, filter) {
    const gl = this.gl;
    gl.texParameteri(target, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(target, gl.TEXTURE_MAG_FILTER, filter);
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) {
      gl.texParameteri(target, axis, gl.CLAMP_TO_EDGE);
    }
  }

  texture3D(name, internal, format, type, [width, height, depth], values, filter = this.gl.NEAREST) {
    const gl = this.gl;
    this.bind(name, gl.TEXTURE_3D, filter);
    gl.texImage3D(gl.TEXTURE_3D, 0, internal, width, height, depth, 0, format, type, values);
  }

  program(fragment) {
    const gl = this.gl;
    const program = gl.createProgram();
    // One triangle that covers the whole image.
    const vertex = `#version 300 es
      void main() { gl_Position = vec4(4 * (gl_VertexID & 1) - 1, 2 * (gl_VertexID & 2) - 1, 0, 1); }`;
    for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(["The graphics driver refuses the shader.", ...logs, gl.getProgramInfoLog(program)].join("\n"));
    }
    gl.useProgram(program);
    const uniforms = {};
    for (let i = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) - 1; i >= 0; --i) {
      const { name, type } = gl.getActiveUniform(program, i);
      uniforms[name.replace("[0]", "")] = { type, location: gl.getUniformLocation(program, name) };
    }
    UNITS.forEach((name, unit) => uniforms[name] && gl.uniform1i(uniforms[name].location, unit));
    return { program, uniforms };
  }

  setUniforms(program, values) {
    const gl = this.gl;
    const setters = {
      [gl.FLOAT]: "uniform1fv", [gl.FLOAT_VEC2]: "uniform2fv", [gl.FLOAT_VEC3]: "uniform3fv",
      [gl.INT]: "uniform1iv", [gl.BOOL]: "uniform1iv", [gl.INT_VEC2]: "uniform2iv", [gl.INT_VEC3]: "uniform3iv",
      [gl.SAMPLER_2D]: "uniform1iv",
    };
    for (const [name, value] of Object.entries(values)) {
      const uniform = this.programs[program].uniforms[name];
      if (!uniform) continue; // the compiler has removed an unused uniform
      if (uniform.type === gl.FLOAT_MAT3) gl.uniformMatrix3fv(uniform.location, false, value);
      else gl[setters[uniform.type]](uniform.location, [value].flat());
    }
  }
}

// Apply a function to the coordinates of all corners along each axis.
const alongAxes = (reduce, corners) => [0, 1, 2].map((axis) => reduce(...corners.map((corner) => corner[axis])));
const source = (name) => document.getElementById(`${name}.glsl`).textContent.trim();
