// Everything outside the viewer: pictures of Figure 7, plots with values on hover, the choice of the metric.

// ---- pictures in the text -------------------------------------------------------------------------------------------

const near = new IntersectionObserver(
  (entries) => {
    for (const { target, isIntersecting } of entries) {
      target.near = isIntersecting;
      if (isIntersecting) target.show();
    }
  },
  { rootMargin: "400px" },
);

for (const canvas of document.querySelectorAll("canvas[data-shot]")) {
  const shot = SHOTS[canvas.dataset.shot];
  [canvas.width, canvas.height] = [shot.width, shot.height];
  canvas.show = async () => {
    const surface = await shot.surface("image", exposure.value);
    canvas.getContext("2d").drawImage(surface, 0, 0);
  };
  near.observe(canvas);
  canvas.closest("button").addEventListener("click", () => openShot(shot.index));
}

exposure.listeners.push(() => {
  for (const canvas of document.querySelectorAll("canvas[data-shot]")) if (canvas.near) canvas.show();
});

// Show a picture in the viewer.
function openShot(index) {
  INDEX.cases.forEach((entry, atCase) =>
    entry.views.forEach((view, atView) =>
      view.groups.forEach((group, atGroup) => {
        const pinned = group.shots.indexOf(index);
        if (pinned >= 0) choose({ case: atCase, view: atView, group: atGroup, pinned });
      }),
    ),
  );
  element("viewer").scrollIntoView({ behavior: "smooth" });
}

for (const input of document.querySelectorAll("input.exposure")) {
  input.addEventListener("input", () => setExposure(Number(input.value)));
}

// ---- plots ----------------------------------------------------------------------------------------------------------

const tip = element("tip");

for (const holder of document.querySelectorAll(".plot")) {
  holder.show = async () => {
    const wanted = holder.dataset.plot;
    if (holder.shown === wanted || !wanted) return;
    holder.shown = wanted;
    const { svg, points } = JSON.parse(new TextDecoder().decode(await inflate(wanted)));
    if (holder.shown !== wanted) return;
    holder.innerHTML = svg;
    holder.points = points;
  };
  near.observe(holder);
  holder.addEventListener("pointermove", (event) => showNearest(holder, event));
  holder.addEventListener("pointerdown", (event) => showNearest(holder, event));
  holder.addEventListener("pointerleave", () => (tip.hidden = true));
}

// The values of the marker that is nearest to the pointer, if one is near.
function showNearest(holder, event) {
  let best = 18, text = null, place = null;
  for (const [group, texts] of Object.entries(holder.points ?? {})) {
    holder.querySelectorAll(`[data-points="${group}"] use`).forEach((marker, index) => {
      const box = marker.getBoundingClientRect();
      const x = box.left + box.width / 2, y = box.top + box.height / 2;
      const distance = Math.hypot(event.clientX - x, event.clientY - y);
      if (distance < best) [best, text, place] = [distance, texts[index], [x, y]];
    });
  }
  tip.hidden = text === null;
  if (text === null) return;
  tip.textContent = text;
  const left = Math.min(Math.max(place[0] - tip.offsetWidth / 2, 6), document.documentElement.clientWidth - tip.offsetWidth - 6);
  const above = place[1] - tip.offsetHeight - 12;
  tip.style.left = `${left}px`;
  tip.style.top = `${above > 6 ? above : place[1] + 14}px`;
}

// ---- the metric and what it is plotted over -------------------------------------------------------------------------

const chosen = { metric: "rmse", axis: "spp" };

function chooseMetric(changes) {
  Object.assign(chosen, changes);
  const onlySpp = chosen.metric === "mean_error";
  const axis = onlySpp ? "spp" : chosen.axis;
  for (const button of document.querySelectorAll("[data-choose]")) {
    const { choose: kind, value } = button.dataset;
    button.setAttribute("aria-pressed", value === (kind === "axis" ? axis : chosen.metric));
    button.disabled = kind === "axis" && onlySpp && value !== "spp";
  }
  for (const table of document.querySelectorAll("[data-metric]")) table.hidden = table.dataset.metric !== chosen.metric;
  for (const holder of document.querySelectorAll(".plot[data-crop]")) {
    const id = `plot/${holder.dataset.crop}/${chosen.metric}/${axis}`;
    holder.dataset.plot = document.getElementById(id) ? id : "";
    if (holder.near) holder.show();
  }
}

for (const button of document.querySelectorAll("[data-choose]")) {
  button.addEventListener("click", () => chooseMetric({ [button.dataset.choose]: button.dataset.value }));
}

chooseMetric({});
choose({});
setExposure(exposure.value);
