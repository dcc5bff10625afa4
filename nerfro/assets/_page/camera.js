// Views are pinhole cameras: position of the eye (world units), axes right, up and back (nine numbers), focal lengths,
// principal point and image size (pixels), and the arc length at which rays begin (near).

const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const addScaled = (a, s, b) => a.map((x, i) => x + s * b[i]);
const unit = (a) => a.map((x) => x / Math.hypot(...a));
const MAX_ELEVATION = 1.55; // radians; an orbit has no direction up above its target
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// Return the view of a camera of the data set.
const viewOf = (camera) => ({
  eye: camera.eye, axes: camera.axes, focal: camera.focal, principal: camera.principal, size: camera.size, near: camera.near,
});

// Return the axes of the room in which the background stands still, in the world of the object: those of the world, or on
// a turntable those of the camera, with the axis of rotation up if it is known (see core/cameras.py).
function roomAxes(axes, turntable) {
  if (!turntable) return [1, 0, 0, 0, 1, 0, 0, 0, 1];
  const up = turntable === true ? axes.slice(3, 6) : unit(turntable);
  const right = axes.slice(0, 3);
  const across = unit(addScaled(right, -dot(right, up), up));
  return [...cross(across, up), ...across, ...up];
}

// A camera on a sphere around a target, which it looks at. Its state is target, radius, azimuth and elevation.
class Orbit {
  constructor({ up, target, radius, near }) {
    this.up = up;
    this.home = { target, radius, near };
    const sideways = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    this.first = unit(addScaled(sideways, -dot(sideways, up), up));
    this.second = cross(up, this.first);
    this.reset();
  }

  // Show the whole object, with a margin.
  reset() {
    this.fieldOfView = 0.7; // radians, along the shorter side of the image
    this.target = this.home.target;
    this.radius = (1.1 * this.home.radius) / Math.sin(0.5 * this.fieldOfView);
    this.azimuth = 0.6;
    this.elevation = 0.35;
  }

  // Move to the eye of another view, and look at the initial target.
  follow(view) {
    this.target = this.home.target;
    const offset = addScaled(view.eye, -1, this.target);
    this.radius = Math.hypot(...offset);
    this.azimuth = Math.atan2(dot(offset, this.second), dot(offset, this.first));
    this.elevation = Math.asin(clamp(dot(offset, this.up) / this.radius, -1, 1));
    this.fieldOfView = 2 * Math.atan((0.5 * Math.min(...view.size)) / Math.min(...view.focal));
    this.turn(0, 0);
  }

  numbers() {
    return [this.azimuth, this.elevation, this.radius, ...this.target, this.fieldOfView];
  }

  setNumbers([azimuth, elevation, radius, x, y, z, fieldOfView]) {
    Object.assign(this, { azimuth, elevation, radius, target: [x, y, z], fieldOfView });
  }

  turn(right, up) {
    this.azimuth -= right;
    this.elevation = clamp(this.elevation + up, -MAX_ELEVATION, MAX_ELEVATION);
  }

  zoom(factor) {
    this.radius = clamp(this.radius * factor, 0.05 * this.home.radius, 20 * this.home.radius);
  }

  // Move the target parallel to the image plane, by fractions of the radius.
  pan(right, up) {
    const { axes } = this.view([1, 1]);
    this.target = addScaled(this.target, -right * this.radius, axes.slice(0, 3));
    this.target = addScaled(this.target, -up * this.radius, axes.slice(3, 6));
  }

  view([width, height]) {
    const horizontal = Math.cos(this.elevation);
    let back = this.up.map((x) => x * Math.sin(this.elevation));
    back = addScaled(back, horizontal * Math.cos(this.azimuth), this.first);
    back = addScaled(back, horizontal * Math.sin(this.azimuth), this.second);
    const right = unit(cross(this.up, back));
    const focal = (0.5 * Math.min(width, height)) / Math.tan(0.5 * this.fieldOfView);
    return {
      eye: addScaled(this.target, this.radius, back), axes: [...right, ...cross(back, right), ...back],
      focal: [focal, focal], principal: [width / 2, height / 2], size: [width, height],
      near: Math.min(this.home.near, 0.5 * this.radius),
    };
  }
}
