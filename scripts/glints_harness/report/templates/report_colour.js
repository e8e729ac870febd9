// From radiance and errors to colours. No value is replaced: infinite and undefined pixels are magenta everywhere.

const INVALID = [255, 0, 255];
const EPSILON = INDEX.epsilon;

// 8-bit sRGB by the upper 16 bits of a float32, which display needs no more of; see `tone_map` in images.py.
const toneTable = new Uint8Array(65536);
let toneExposure = null;

function prepareTones(exposure) {
  if (exposure === toneExposure) return;
  const bits = new Uint32Array(1), value = new Float32Array(bits.buffer), scale = 2 ** exposure;
  for (let i = 0; i < 65536; i++) {
    bits[0] = i << 16;
    const linear = Math.min(Math.max(value[0] * scale || 0, 0), 1);
    toneTable[i] = 255 * (linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055) + 0.5;
  }
  toneExposure = exposure;
}

function paintTones(pixels, exposure) {
  prepareTones(exposure);
  const bits = new Uint32Array(pixels.buffer), painted = new Uint8ClampedArray((pixels.length / 3) * 4);
  for (let i = 0, o = 0; i < bits.length; i += 3, o += 4) {
    if (Number.isFinite(pixels[i] + pixels[i + 1] + pixels[i + 2])) {
      for (let c = 0; c < 3; c++) painted[o + c] = toneTable[bits[i + c] >>> 16];
    } else painted.set(INVALID, o);
    painted[o + 3] = 255;
  }
  return painted;
}

// One number a pixel: the mean over the channels of `error(value, reference)`.
function perPixel(pixels, reference, error) {
  const found = new Float32Array(pixels.length / 3);
  for (let i = 0; i < found.length; i++) {
    for (let c = 3 * i; c < 3 * i + 3; c++) found[i] += error(pixels[c], reference[c]) / 3;
  }
  return found;
}

const squaredRelative = (value, reference) => (value - reference) ** 2 / (reference ** 2 + EPSILON);
const signedRelative = (value, reference) => (value - reference) / Math.sqrt(reference ** 2 + EPSILON);

const colourTables = Object.fromEntries(
  Object.entries(INDEX.colours).map(([name, text]) => [name, text.match(/../g).map((pair) => parseInt(pair, 16))]),
);

// Numbers by a colour table; `place` maps a number to [0, 1], beyond which the end colours stay.
function paintTable(values, name, place) {
  const table = colourTables[name], painted = new Uint8ClampedArray(4 * values.length);
  for (let i = 0; i < values.length; i++) {
    const at = 3 * Math.round(255 * Math.min(Math.max(place(values[i]), 0), 1));
    painted.set(Number.isFinite(values[i]) ? table.slice(at, at + 3) : INVALID, 4 * i);
    painted[4 * i + 3] = 255;
  }
  return painted;
}

// What a picture can show. `numbers` gives one number a pixel, `place` its position on the scale.
const MODES = {
  image: {
    available: () => true,
    paint: async (shot, exposure) => paintTones(await shot.pixels(), exposure),
  },
  relative: {
    available: (shot) => shot.reference !== null,
    numbers: async (shot) => perPixel(await shot.pixels(), await SHOTS[shot.reference].pixels(), squaredRelative),
    place: (value) => (Math.log10(value) + 4) / 6,
    table: "inferno",
    scale: ["10⁻⁴", "10⁻²", "1", "100"],
    name: "relative squared error",
  },
  signed: {
    available: (shot) => shot.reference !== null,
    numbers: async (shot) => perPixel(await shot.pixels(), await SHOTS[shot.reference].pixels(), signedRelative),
    place: (value) => (value + 1) / 2,
    table: "signed",
    scale: ["−1: darker", "0", "+1: brighter"],
    name: "signed relative error",
  },
  flip: {
    available: (shot) => shot.flip !== null,
    numbers: (shot) => shot.flipMap(),
    place: (value) => value,
    table: "magma",
    scale: ["0", "0.5", "1"],
    name: "HDR-FLIP",
  },
};
for (const mode of Object.values(MODES)) {
  mode.paint ??= async (shot) => paintTable(await mode.numbers(shot), mode.table, mode.place);
}

const exposure = { value: INDEX.exposure, listeners: [] };

function setExposure(value) {
  exposure.value = Math.min(Math.max(value, -12), 12);
  for (const input of document.querySelectorAll("input.exposure")) {
    input.value = exposure.value;
    const sign = exposure.value > 0 ? "+" : exposure.value < 0 ? "−" : "";
    input.parentElement.querySelector("output").textContent = `${sign}${Math.abs(exposure.value)} stops`;
  }
  for (const listener of exposure.listeners) listener();
}
