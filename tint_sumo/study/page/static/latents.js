// The latent space of a trait model: a window's trajectory, its driver and its nearest neighbours.

const SPACE = { width: 440, height: 400, margin: 34 };
const TRACE = { width: 440, height: 190, margin: 40 };
const NEIGHBOURS = 5;

// A line that maps numbers to places in a drawing.
const scale = (values, from, to) => {
  const low = Math.min(...values);
  const span = Math.max(...values) - low || 1;
  return (value) => from + ((value - low) / span) * (to - from);
};

class LatentSpace {
  constructor({ traits, step_m: step, step_s, windows, models }) {
    Object.assign(this, { traits, step, step_s, windows, models });
    this.svg = document.querySelector("#space svg");
    for (const { name, is_trained: isTrained } of models) byId("model").append(make("option", { value: name }, isTrained ? name : `${name} (shipped)`));
    byId("model").addEventListener("change", () => this.draw());
    byId("space").addEventListener("keydown", (event) => this.key(event));
    for (const kind of ["pointermove", "click"]) this.svg.addEventListener(kind, (event) => this.point(event));
    byId("neighbours").addEventListener("click", ({ target }) => {
      if (target.matches("button")) this.choose(Number(target.dataset.window));
    });
    this.chosen = 0;
    this.draw();
  }

  draw() {
    const { latents } = this.models.find((one) => one.name === byId("model").value);
    const { width, height, margin } = SPACE;
    const x = scale(latents.map((one) => one[0]), margin, width - 12);
    const y = scale(latents.map((one) => one[1]), height - margin, 12);
    this.latents = latents;
    this.places = latents.map((one) => [x(one[0]), y(one[1])]);
    this.points = this.places.map(([px, py], number) => {
      const { trait } = this.windows[number];
      const shape = trait ? `M${px} ${py - 5.5}l5 9h-10z` : `M${px - 4.5} ${py}a4.5 4.5 0 1 0 9 0a4.5 4.5 0 1 0 -9 0z`;
      return makeSvg("path", { class: `point trait${trait}`, d: shape, "data-window": number });
    });
    this.svg.replaceChildren(
      makeSvg("path", { class: "axis", d: `M${margin} 0V${height - margin + 8}H${width}`, fill: "none" }),
      makeSvg("text", { x: width / 2, y: height - 6, "text-anchor": "middle" }, "latent 1"),
      makeSvg("text", { transform: `translate(16 ${height / 2}) rotate(-90)`, "text-anchor": "middle" }, "latent 2"),
      ...this.points,
    );
    this.choose(this.chosen);
  }

  choose(number) {
    const { latents, windows } = this;
    const away = (one) => Math.hypot(latents[one][0] - latents[number][0], latents[one][1] - latents[number][1]);
    const others = windows.map((_, one) => one).filter((one) => one !== number);
    const near = others.sort((one, other) => away(one) - away(other)).slice(0, NEIGHBOURS);
    this.chosen = number;
    this.points.forEach((point, one) => {
      point.classList.toggle("chosen", one === number);
      point.classList.toggle("near", near.includes(one));
    });
    this.svg.append(this.points[number]); // on top of the others
    byId("window-text").textContent = this.words(number, near);
    byId("neighbours").replaceChildren(
      ...near.map((one) => {
        const item = make("li");
        item.append(make("button", { type: "button", "data-window": one }, `${this.name(one)}, ${away(one).toFixed(3)} away`));
        return item;
      }),
    );
    this.trace("window-offsets", "offsets", "position (m)", number, near);
    this.trace("window-gaps", "gaps", "gap to the leader (m)", number, near);
  }

  name(number) {
    const { driver, trait } = this.windows[number];
    return `driver ${driver}, ${this.traits[trait]}`;
  }

  words(number, near) {
    const { trait, desired_speed_mps: speed, min_gap_m: gap, offsets } = this.windows[number];
    const [first, second] = this.latents[number];
    const alike = near.filter((one) => this.windows[one].trait === trait).length;
    const seconds = (offsets.length * this.step_s).toFixed(1);
    return (
      `Window of ${this.name(number)} in truth, who wants to drive ${speed.toFixed(1)} m/s and keeps a gap of ` +
      `${gap.toFixed(2)} m when it stands; seen for ${seconds} s. Latents ${first.toFixed(2)} and ${second.toFixed(2)}; ${alike} of ${near.length} neighbours share its trait.`
    );
  }

  trace(name, column, title, number, near) {
    const { width, height, margin } = TRACE;
    const own = [...near, number].map((one) => ({ one, values: this.windows[one][column] }));
    const known = own.flatMap(({ values }) => values.filter((value) => value !== null));
    const x = scale([0, Math.max(...own.map(({ values }) => values.length)) - 1], margin, width - 12);
    const y = scale(known.length ? known : [0], height - 30, 14);
    const lines = own.map(({ one, values }) => {
      const places = values.map((value, step) => (value === null ? "" : `${x(step).toFixed(1)},${y(value).toFixed(1)}`));
      const kind = `trace trait${this.windows[one].trait}${one === number ? " chosen" : ""}`;
      return makeSvg("polyline", { class: kind, points: places.join(" ") });
    });
    const ends = known.length ? [Math.min(...known), Math.max(...known)] : [];
    byId(name).replaceChildren(
      makeSvg("path", { class: "axis", d: `M${margin} 0V${height - 24}H${width}`, fill: "none" }),
      makeSvg("text", { x: width - 12, y: height - 8, "text-anchor": "end" }, "time →"),
      makeSvg("text", { x: margin + 6, y: 14 }, title),
      ...ends.map((value) => makeSvg("text", { x: margin - 5, y: y(value) + 4, "text-anchor": "end" }, (value * this.step).toFixed(1))),
      ...(known.length ? [] : [makeSvg("text", { x: width / 2, y: height / 2, "text-anchor": "middle" }, "nobody drives ahead")]),
      ...lines,
    );
  }

  // The window nearest to the pointer, if it is near.
  point(event) {
    const box = this.svg.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * SPACE.width;
    const y = ((event.clientY - box.top) / box.height) * SPACE.height;
    const away = this.places.map(([px, py]) => Math.hypot(px - x, py - y));
    const number = away.indexOf(Math.min(...away));
    if (away[number] < (event.type === "click" ? 40 : 8)) this.choose(number);
  }

  // The nearest window in the direction of an arrow.
  key(event) {
    const directions = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (event.key === "Home") this.choose(0);
    else if (event.key in directions) this.go(...directions[event.key]);
    else return;
    event.preventDefault();
  }

  go(right, down) {
    const [x, y] = this.places[this.chosen];
    let best = null;
    this.places.forEach(([px, py], number) => {
      const ahead = (px - x) * right + (py - y) * down;
      const aside = Math.abs((px - x) * down + (py - y) * right);
      const cost = ahead + 3 * aside;
      if (ahead > 0 && aside <= 2 * ahead && (best === null || cost < best.cost)) best = { number, cost };
    });
    if (best) this.choose(best.number);
  }
}

if (byId("latent-data")) unpack("latent-data").then((text) => new LatentSpace(JSON.parse(text)));
