// The viewer: one large picture (the stage) and all pictures of the same scene, view and sample count beside it (the
// wall), with one window into all of them.

const viewer = {
  case: 0,
  view: 0,
  group: 0,
  mode: "image",
  pinned: 0, // position in the group of the picture on the stage
  hovered: null, // position of the picture that is on the stage as long as the pointer is over its tile
  zoom: 1,
  centre: [0.5, 0.5], // of the window, in parts of the picture
  pixel: null, // under the pointer
};

const element = (id) => document.getElementById(id);
const stage = element("stage"), wall = element("wall");
let tiles = [];
let drawing = 0; // number of the last drawing, so that an overtaken one stops

const currentView = () => INDEX.cases[viewer.case].views[viewer.view];
const currentGroup = () => currentView().groups[viewer.group];
const currentShots = () => currentGroup().shots.map((index) => SHOTS[index]);
const currentShot = () => currentShots()[viewer.hovered ?? viewer.pinned];

// ---- choosing -------------------------------------------------------------------------------------------------------

function choose(changes) {
  const method = currentShots()[viewer.pinned]?.label;
  Object.assign(viewer, changes);
  viewer.view = Math.min(viewer.view, INDEX.cases[viewer.case].views.length - 1);
  viewer.group = Math.min(viewer.group, currentView().groups.length - 1);
  if (!("pinned" in changes)) {
    viewer.pinned = Math.max(0, currentShots().findIndex((shot) => shot.label === method));
  }
  viewer.hovered = null;
  viewer.pixel = null;
  if ("case" in changes || "view" in changes) resetWindow();
  fillControls();
  fillWall();
  redraw();
}

function flip(position) {
  const count = currentShots().length;
  viewer.pinned = ((position % count) + count) % count;
  viewer.hovered = null;
  redraw();
}

// Between the picture on the stage and its reference, and back.
function flipReference() {
  const shots = currentShots(), shown = shots[viewer.pinned];
  if (shown.method === "reference") flip(viewer.before ?? 0);
  else {
    viewer.before = viewer.pinned;
    const at = shots.findIndex((shot) => shot.index === shown.reference);
    if (at >= 0) flip(at);
  }
}

function buttons(parent, entries, selected, action) {
  parent.replaceChildren(
    ...entries.map(({ title, disabled, hint }, index) => {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: title, disabled: Boolean(disabled), title: hint ?? "" });
      button.setAttribute("aria-pressed", index === selected);
      button.addEventListener("click", () => action(index));
      return button;
    }),
  );
}

function fillControls() {
  buttons(element("choose-case"), INDEX.cases, viewer.case, (index) => choose({ case: index }));
  buttons(element("choose-view"), INDEX.cases[viewer.case].views, viewer.view, (index) => choose({ view: index, group: 0 }));
  buttons(element("choose-group"), currentView().groups, viewer.group, (index) => choose({ group: index }));
  const names = Object.keys(MODES);
  const available = (name) => currentShots().some((shot) => MODES[name].available(shot));
  if (!available(viewer.mode)) viewer.mode = "image";
  const modes = names.map((name) => ({
    title: MODES[name].name ?? "image",
    disabled: !available(name),
    hint: available(name) ? "" : "not for this view",
  }));
  buttons(element("choose-mode"), modes, names.indexOf(viewer.mode), (index) => {
    viewer.mode = names[index];
    fillControls();
    redraw();
  });
  fillScale();
}

function fillScale() {
  const { table, scale, name } = MODES[viewer.mode], bar = element("scale");
  bar.hidden = !table;
  if (!table) return;
  const colours = colourTables[table], stops = [];
  for (let i = 0; i < 256; i += 15) stops.push(`rgb(${colours.slice(3 * i, 3 * i + 3)})`);
  bar.querySelector(".ramp").style.background = `linear-gradient(90deg, ${stops})`;
  bar.querySelector(".ticks").replaceChildren(...scale.map((text) => Object.assign(document.createElement("span"), { textContent: text })));
  bar.querySelector(".name").textContent = name;
}

function fillWall() {
  tiles = currentShots().map((shot, position) => {
    const tile = element("tile").content.firstElementChild.cloneNode(true);
    tile.querySelector(".key").textContent = position < 9 ? position + 1 : "";
    tile.querySelector(".label").textContent = shot.label;
    tile.querySelector(".detail").textContent = describe(shot).join("\n");
    tile.setAttribute("aria-label", [shot.label, ...describe(shot)].join(", "));
    tile.addEventListener("click", () => flip(position));
    tile.addEventListener("pointerenter", (event) => event.pointerType === "mouse" && hover(position));
    tile.addEventListener("pointerleave", (event) => event.pointerType === "mouse" && hover(null));
    const canvas = tile.querySelector("canvas");
    canvas.style.aspectRatio = `${shot.width} / ${shot.height}`;
    canvas.addEventListener("pointermove", (event) => point(event, canvas));
    return tile;
  });
  const absent = currentGroup().absent.map(({ label }) => {
    const gap = element("gap").content.firstElementChild.cloneNode(true);
    gap.querySelector(".label").textContent = label;
    return gap;
  });
  wall.replaceChildren(...tiles, ...absent);
  stage.style.aspectRatio = `${currentShots()[0].width} / ${currentShots()[0].height}`;
}

function hover(position) {
  viewer.hovered = position;
  if (position === null) viewer.pixel = null;
  redraw();
}

function describe(shot) {
  const parts = [shot.detail];
  const error = (name) => shot.errors[name] + (shot.noisy.includes(name) ? " ≈" : "");
  if (shot.method === "reference") parts.push(`own noise (RMSE) ${shot.errors.rmse}`);
  else if (shot.errors.rmse) parts.push(`RMSE ${error("rmse")}`);
  if (shot.errors.flip) parts.push(`FLIP ${error("flip")}`);
  if (shot.invalid) parts.push(`${shot.invalid} invalid ${shot.invalid === 1 ? "pixel" : "pixels"}`);
  return parts;
}

// ---- drawing --------------------------------------------------------------------------------------------------------

async function redraw() {
  const mine = ++drawing, shots = currentShots(), shown = currentShot();
  element("stage-label").textContent = shown.label;
  element("stage-detail").textContent = describe(shown).join(" · ");
  tiles.forEach((tile, position) => tile.setAttribute("aria-pressed", position === viewer.pinned));
  const order = [[stage, shown], ...tiles.map((tile, position) => [tile.querySelector("canvas"), shots[position]])];
  for (const [canvas, shot] of order) {
    const surface = MODES[viewer.mode].available(shot) ? await shot.surface(viewer.mode, exposure.value) : null;
    if (mine !== drawing) return;
    drawWindow(canvas, surface);
  }
  readPixel(shown);
}

// The part of the picture that is in the window, in its pixels.
function windowOf(width, height) {
  const w = width / viewer.zoom, h = height / viewer.zoom;
  return { x: viewer.centre[0] * width - w / 2, y: viewer.centre[1] * height - h / 2, w, h };
}

function drawWindow(canvas, surface) {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
  canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
  const context = canvas.getContext("2d");
  if (!surface) return;
  const part = windowOf(surface.width, surface.height);
  context.imageSmoothingEnabled = canvas.width < part.w; // enlarged pixels stay squares
  context.drawImage(surface, part.x, part.y, part.w, part.h, 0, 0, canvas.width, canvas.height);
  if (viewer.pixel) {
    const size = canvas.width / part.w, [x, y] = viewer.pixel;
    context.lineWidth = Math.max(1, ratio);
    context.strokeStyle = "#fff";
    context.strokeRect((x - part.x) * size - 1, (y - part.y) * size - 1, size + 2, size + 2);
    context.strokeStyle = "#000";
    context.strokeRect((x - part.x) * size - 2.5, (y - part.y) * size - 2.5, size + 5, size + 5);
  }
}

const digits = (value) => (Number.isFinite(value) ? value.toPrecision(3) : String(value).replace("Infinity", "∞"));

async function readPixel(shot) {
  const readout = element("readout");
  if (!viewer.pixel) {
    readout.textContent = readout.dataset.idle;
    return;
  }
  const [x, y] = viewer.pixel, at = y * shot.width + x;
  const triple = (pixels) => Array.from(pixels.slice(3 * at, 3 * at + 3), digits).join(" ");
  let text = `(${x}, ${y})  ${triple(await shot.pixels())}`;
  if (shot.reference !== null && shot.reference !== shot.index) {
    text += `  reference ${triple(await SHOTS[shot.reference].pixels())}`;
    for (const name of ["relative", "signed", "flip"]) {
      if (MODES[name].available(shot)) text += `  ${MODES[name].name} ${digits(await pixelError(shot, name, at))}`;
    }
  }
  readout.textContent = text;
}

async function pixelError(shot, name, at) {
  if (name === "flip") return (await shot.flipMap())[at];
  const cut = (pixels) => pixels.slice(3 * at, 3 * at + 3);
  const error = name === "relative" ? squaredRelative : signedRelative;
  return perPixel(cut(await shot.pixels()), cut(await SHOTS[shot.reference].pixels()), error)[0];
}

// ---- zoom and pan ---------------------------------------------------------------------------------------------------

function resetWindow() {
  viewer.zoom = 1;
  viewer.centre = [0.5, 0.5];
  stage.classList.remove("zoomed");
}

function moveWindow(zoom, centre) {
  viewer.zoom = Math.min(Math.max(zoom, 1), currentShots()[0].width / 6);
  const margin = 0.5 / viewer.zoom;
  viewer.centre = centre.map((value) => Math.min(Math.max(value, margin), 1 - margin));
  stage.classList.toggle("zoomed", viewer.zoom > 1);
  redraw();
}

// Zoom by a factor so that what is at `place` (parts of the canvas) stays there.
function zoomAt(factor, place) {
  const zoom = Math.min(Math.max(viewer.zoom * factor, 1), currentShots()[0].width / 6);
  const shift = 1 / viewer.zoom - 1 / zoom;
  moveWindow(zoom, viewer.centre.map((value, axis) => value + (place[axis] - 0.5) * shift));
}

function placeIn(event, canvas) {
  const box = canvas.getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
}

function point(event, canvas) {
  const shot = currentShot(), part = windowOf(shot.width, shot.height), [u, v] = placeIn(event, canvas);
  const x = Math.floor(part.x + u * part.w), y = Math.floor(part.y + v * part.h);
  viewer.pixel = x >= 0 && y >= 0 && x < shot.width && y < shot.height ? [x, y] : null;
  redraw();
}

const pointers = new Map();

stage.addEventListener("pointerdown", (event) => {
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
  stage.setPointerCapture(event.pointerId);
});

stage.addEventListener("pointermove", (event) => {
  const before = pointers.get(event.pointerId);
  if (!before) return point(event, stage);
  const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
  if (others.length === 1) {
    const distance = (place) => Math.hypot(place[0] - others[0][0], place[1] - others[0][1]);
    const middle = { clientX: (event.clientX + others[0][0]) / 2, clientY: (event.clientY + others[0][1]) / 2 };
    zoomAt(distance([event.clientX, event.clientY]) / Math.max(distance(before), 1), placeIn(middle, stage));
  } else if (others.length === 0 && viewer.zoom > 1) {
    const box = stage.getBoundingClientRect();
    const moved = [(event.clientX - before[0]) / box.width, (event.clientY - before[1]) / box.height];
    moveWindow(viewer.zoom, viewer.centre.map((value, axis) => value - moved[axis] / viewer.zoom));
  }
});

for (const kind of ["pointerup", "pointercancel"]) {
  stage.addEventListener(kind, (event) => pointers.delete(event.pointerId));
}
stage.addEventListener("pointerleave", () => hover(null));
stage.addEventListener("dblclick", () => moveWindow(1, [0.5, 0.5]));

// Over the stage the wheel zooms; when there is nothing left to zoom out of, the page scrolls.
stage.addEventListener("wheel", (event) => {
  if (event.deltaY > 0 && viewer.zoom === 1) return;
  event.preventDefault();
  const step = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 33 : 1;
  zoomAt(2 ** ((-event.deltaY * step) / 300), placeIn(event, stage));
}, { passive: false });

// One finger scrolls the page until the picture is enlarged; two fingers belong to the viewer.
stage.addEventListener("touchstart", (event) => event.touches.length > 1 && event.preventDefault(), { passive: false });

// ---- keys -----------------------------------------------------------------------------------------------------------

const KEYS = {
  r: flipReference,
  ArrowRight: (event) => (event.shiftKey ? pan(1, 0) : flip(viewer.pinned + 1)),
  ArrowLeft: (event) => (event.shiftKey ? pan(-1, 0) : flip(viewer.pinned - 1)),
  ArrowUp: (event) => (event.shiftKey ? pan(0, -1) : false),
  ArrowDown: (event) => (event.shiftKey ? pan(0, 1) : false),
  "+": () => zoomAt(1.5, [0.5, 0.5]),
  "-": () => zoomAt(1 / 1.5, [0.5, 0.5]),
  0: () => moveWindow(1, [0.5, 0.5]),
  "[": () => setExposure(exposure.value - 0.5),
  "]": () => setExposure(exposure.value + 0.5),
};
for (let digit = 1; digit <= 9; digit++) KEYS[digit] = () => digit <= currentShots().length && flip(digit - 1);

function pan(x, y) {
  const step = 0.1 / viewer.zoom;
  moveWindow(viewer.zoom, [viewer.centre[0] + x * step, viewer.centre[1] + y * step]);
}

// Keys act while the viewer is on the screen, unless something else that takes keys has the focus.
let onScreen = false;
new IntersectionObserver((entries) => (onScreen = entries.at(-1).isIntersecting)).observe(element("viewer-body"));

document.addEventListener("keydown", (event) => {
  const busy = event.target.closest("input, select, textarea, [contenteditable]");
  if (!onScreen || busy || event.ctrlKey || event.metaKey || event.altKey || !(event.key in KEYS)) return;
  if (KEYS[event.key](event) !== false) event.preventDefault();
});

exposure.listeners.push(redraw);
new ResizeObserver(() => redraw()).observe(stage);
