// Decoding of the page's data: base64 text in script elements, deflated. Nothing is decoded before it is needed.

async function inflate(id) {
  const text = atob(document.getElementById(id).textContent);
  const packed = Uint8Array.from(text, (character) => character.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// One plane of integers: zigzag numbers in three byte planes, each less the mean of its left and upper neighbour.
function unpackPlane(bytes, plane, width, height) {
  const size = width * height, values = new Int32Array(size);
  for (let y = 0, i = 0; y < height; y++) {
    for (let x = 0; x < width; x++, i++) {
      const at = plane * size + i;
      const zigzag = (bytes[at] << 16) | (bytes[at + 3 * size] << 8) | bytes[at + 6 * size];
      const residual = zigzag & 1 ? -(zigzag + 1) / 2 : zigzag / 2;
      values[i] = residual + (((x ? values[i - 1] : 0) + (y ? values[i - width] : 0)) >> 1);
    }
  }
  return values;
}

// The inverse of `pack` in images.py: linear radiance, red, green, blue of one pixel after the other.
function unpackImage(bytes, width, height, mantissa) {
  const [green, red, blue] = [0, 1, 2].map((plane) => unpackPlane(bytes, plane, width, height));
  const pixels = new Float32Array(3 * width * height), bits = new Uint32Array(pixels.buffer);
  const shift = 23 - mantissa;
  for (let i = 0; i < green.length; i++) {
    bits[3 * i] = (red[i] + green[i]) << shift;
    bits[3 * i + 1] = green[i] << shift;
    bits[3 * i + 2] = (blue[i] + green[i]) << shift;
  }
  return pixels;
}

// A picture of the report. `index` is its number; the other fields are those of `Gallery.add` in report_pictures.py.
class Shot {
  constructor(described, index) {
    Object.assign(this, described, { index });
    this.surfaces = new Map();
  }

  pixels() {
    this.loading ??= inflate(this.data).then((bytes) => unpackImage(bytes, this.width, this.height, this.mantissa));
    return this.loading;
  }

  flipMap() {
    this.loadingFlip ??= inflate(this.flip).then((bytes) => Float32Array.from(bytes, (value) => value / 255));
    return this.loadingFlip;
  }

  // A canvas with this shot in a mode of `MODES`, one pixel each; the last one of every mode is kept.
  async surface(mode, exposure) {
    const key = mode === "image" ? exposure : 0;
    const kept = this.surfaces.get(mode);
    if (kept && kept.key === key) return kept.canvas;
    const painted = await MODES[mode].paint(this, exposure);
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [this.width, this.height];
    canvas.getContext("2d").putImageData(new ImageData(painted, this.width, this.height), 0, 0);
    this.surfaces.set(mode, { key, canvas });
    return canvas;
  }
}

const INDEX = JSON.parse(document.getElementById("index").textContent);
const SHOTS = INDEX.shots.map((described, index) => new Shot(described, index));
