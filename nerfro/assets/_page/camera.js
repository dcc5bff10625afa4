// Views: where the eye is (world units), its axes right, up and back (nine numbers), and the pinhole in pixels.

const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const along = (a, s, b) => a.map((x, i) => x + s * b[i]);
const unit = (a) => a.map((x) => x / Math.hypot(...a));
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// A camera of the data as a view.
const viewOf = (camera) => ({
  eye: camera.eye, axes: camera.axes, focal: camera.focal, principal: camera.principal, size: camera.size, near: camera.near,
});

// An eye on a sphere around a target: turned by angles, moved by its radius.
class Orbit {
  constructor({ up, target, radius, near }) {
    this.up = up;
    this.home = { target, radius, near };
    const sideways = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    this.first = unit(along(sideways, -dot(sideways, up), up));
    this.second = cross(up, this.first);
    this.fieldOfView = 0.7; // radians, of the picture's shorter side
    this.reset();
  }

  reset() {
    this.target = this.home.target;
    this.radius = 2.5 * this.home.radius;
    this.azimuth = 0.6;
    this.elevation = 0.35;
  }

  // Go on from where another view's eye is, looking at the target.
  follow(view) {
    this.target = this.home.target;
    const offset = along(view.eye, -1, this.target);
    this.radius = Math.hypot(...offset);
    this.azimuth = Math.atan2(dot(offset, this.second), dot(offset, this.first));
    this.elevation = Math.asin(clamp(dot(offset, this.up) / this.radius, -1, 1));
    this.fieldOfView = 2 * Math.atan((0.5 * Math.min(...view.size)) / Math.min(...view.focal));
    this.turn(0, 0);
  }

  turn(right, up) {
    this.azimuth -= right;
    this.elevation = clamp(this.elevation + up, -1.55, 1.55);
  }

  zoom(factor) {
    this.radius = clamp(this.radius * factor, 0.05 * this.home.radius, 20 * this.home.radius);
  }

  // Move the target in the picture's plane, by shares of the radius.
  pan(right, up) {
    const { axes } = this.view([1, 1]);
    this.target = along(this.target, -right * this.radius, axes.slice(0, 3));
    this.target = along(this.target, -up * this.radius, axes.slice(3, 6));
  }

  view([width, height]) {
    const flat = Math.cos(this.elevation);
    let back = this.up.map((x) => x * Math.sin(this.elevation));
    back = along(back, flat * Math.cos(this.azimuth), this.first);
    back = along(back, flat * Math.sin(this.azimuth), this.second);
    const right = unit(cross(this.up, back));
    const focal = (0.5 * Math.min(width, height)) / Math.tan(0.5 * this.fieldOfView);
    return {
      eye: along(this.target, this.radius, back), axes: [...right, ...cross(back, right), ...back],
      focal: [focal, focal], principal: [width / 2, height / 2], size: [width, height],
      near: Math.min(this.home.near, 0.5 * this.radius),
    };
  }
}
