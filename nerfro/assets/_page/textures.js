// Arrays are stored as PNG images, which the browser decodes. The tiles of an image are the slices of an array along its
// last axis; see nerfro/viewing/baking.py.

// Return red, green, blue and alpha (255) of every voxel, x fastest.
function unpackVoxels(image, [width, height, depth]) {
  const columns = Math.ceil(Math.sqrt(depth));
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth;
  canvas.height = image.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const mosaic = new Uint32Array(context.getImageData(0, 0, canvas.width, canvas.height).data.buffer);
  const voxels = new Uint32Array(width * height * depth);
  for (let z = 0; z < depth; ++z) {
    for (let y = 0; y < height; ++y) {
      const from = ((Math.floor(z / columns) * height + y) * columns + (z % columns)) * width;
      voxels.set(mosaic.subarray(from, from + width), (z * height + y) * width);
    }
  }
  return new Uint8Array(voxels.buffer);
}

// Decode `two_bytes` of packing.py.
const signedIntegers = (voxels) =>
  Int16Array.from({ length: voxels.length / 4 }, (_, i) => voxels[4 * i] * 256 + voxels[4 * i + 1] - 32768);

const redChannel = (voxels) => Uint8Array.from({ length: voxels.length / 4 }, (_, i) => voxels[4 * i]);

function withAlpha(colours, alphas) {
  for (let i = 0; i < colours.length; i += 4) colours[i + 3] = alphas[i];
  return colours;
}

// Combine the two arrays of `shared_exponent` in packing.py to the format RGB9_E5: `upper` has the upper eight bits of the
// mantissas, `rest` has the exponent and the lowest bits.
function sharedExponent(upper, rest) {
  return Uint32Array.from({ length: upper.length / 4 }, (_, i) => {
    const low = rest[4 * i];
    const mantissa = (channel) => upper[4 * i + channel] * 2 + ((low >> channel) & 1);
    return ((low >> 3) * 2 ** 27 + mantissa(2) * 2 ** 18 + mantissa(1) * 2 ** 9 + mantissa(0)) >>> 0;
  });
}

// Decode an image in Radiance's .hdr format to width, height and linear radiance, four numbers per pixel; see
// files/images.py.
function decodeHdr(bytes) {
  let at = 0;
  const line = () => {
    const end = bytes.indexOf(10, at);
    if (end < 0) throw new Error("the file is truncated");
    const text = String.fromCharCode(...bytes.subarray(at, end));
    at = end + 1;
    return text;
  };
  while (line() !== "");
  const size = /^-Y (\d+) \+X (\d+)$/.exec(line());
  if (!size) throw new Error("only .hdr images with the orientation -Y +X are supported");
  const [height, width] = [Number(size[1]), Number(size[2])];
  const pixels = new Float32Array(4 * width * height);
  const row = new Uint8Array(4 * width);
  for (let y = 0; y < height; ++y) {
    if (bytes[at] === 2 && bytes[at + 1] === 2 && bytes[at + 2] < 128) {
      at += 4;
      for (let i = 0; i < 4 * width; ) {
        const count = bytes[at++];
        if (!count) throw new Error("the file is damaged");
        const repeated = count > 128;
        for (let k = repeated ? count - 128 : count; k > 0; --k, ++i) {
          row[(i % width) * 4 + Math.floor(i / width)] = repeated ? bytes[at] : bytes[at++];
        }
        if (repeated) ++at;
      }
    } else {
      row.set(bytes.subarray(at, at + 4 * width));
      at += 4 * width;
    }
    for (let x = 0; x < width; ++x) {
      const scale = row[4 * x + 3] ? 2 ** (row[4 * x + 3] - 136) : 0;
      for (let c = 0; c < 3; ++c) pixels[4 * (y * width + x) + c] = Math.min((row[4 * x + c] + 0.5) * scale, 6e4);
    }
  }
  return { width, height, pixels };
}
