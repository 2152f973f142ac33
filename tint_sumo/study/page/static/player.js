// The episode player: one or two policies in the same case, at the same time.

class Episode {
  // Columns hold the first number and then the differences; see recording.py.
  constructor(content, contents, traits) {
    const { units, missing } = contents;
    const decode = (columns) =>
      Object.fromEntries(
        Object.entries(columns).map(([name, steps]) => {
          let sum = 0;
          return [name, steps.map((step) => ((sum += step) === missing ? null : sum * units[name]))];
        }),
      );
    this.outcome = content.outcome;
    this.frames = content.frames;
    this.ego = decode(content.ego);
    this.routes = Object.entries(content.routes).map(([name, columns]) => [name, decode(columns).claimed]);
    this.vehicles = content.vehicles.map(({ number, trait, first, ...columns }) => ({
      number,
      kind: trait,
      first,
      columns: decode(columns),
    }));
    this.traits = traits;
  }

  // What there is to see at a frame; after the end, what there was at the end.
  at(frame) {
    const now = Math.min(frame, this.frames - 1);
    const pick = (columns, index) =>
      Object.fromEntries(Object.entries(columns).map(([name, values]) => [name, values[index]]));
    const nothing = { attention: null, p_conservative: null, seen: 1 };
    return {
      ego: { desired_mps: null, value: null, town_rank: null, town_differs: null, ...pick(this.ego, now) },
      claims: this.routes.filter(([, claimed]) => claimed[now]).map(([name]) => name),
      vehicles: this.vehicles
        .filter((one) => now >= one.first && now < one.first + one.columns.x_m.length)
        .map((one) => {
          const columns = pick(one.columns, now - one.first);
          const kind = columns.trait_now ?? one.kind;
          return { number: one.number, kind, trait: this.traits[kind], ...nothing, ...columns };
        }),
      outcome: now === this.frames - 1 ? this.outcome : "",
    };
  }
}

// What the drivers so far say about the town, where a policy compares them.
const townFacts = ({ town_rank: rank, town_differs: differs }) => {
  if (rank === null) return {};
  return { town: `gaps longer than in ${percent(rank)} % of towns, drivers differ with ${percent(differs)} %` };
};

class Pane {
  constructor(element, contents) {
    this.contents = contents;
    [this.method, this.svg, this.list, this.details, this.table] = ["select", "svg", "dl", "details", "table"].map((name) =>
      element.querySelector(name),
    );
    for (const { label, title } of contents.policies) this.method.append(make("option", { value: label }, title));
    this.episode = null;
  }

  // Load what the method did in a case; nothing if no method is chosen.
  async load(number) {
    const policy = this.contents.policies.find((one) => one.label === this.method.value);
    this.svg.toggleAttribute("hidden", !policy);
    this.svg.style.borderTopColor = policy?.colour ?? "";
    this.details.toggleAttribute("hidden", !policy);
    this.episode = null;
    this.list.replaceChildren();
    const name = policy ? `episode-${policy.label}-${number}` : null;
    this.wanted = name;
    if (!policy) return;
    const text = await unpack(name);
    if (this.wanted !== name) return; // something else was chosen meanwhile
    const shapes = this.contents.scene;
    this.episode = new Episode(JSON.parse(text), this.contents, shapes.traits);
    this.step_s = shapes.step_s;
    this.title = policy.title;
    this.view = new SceneView(this.svg, shapes);
  }

  draw(frame) {
    if (!this.episode) return;
    const moment = this.episode.at(frame);
    const facts = this.facts(moment, frame);
    this.view.draw(moment);
    this.list.replaceChildren(
      ...Object.entries(facts).map(([name, value]) => {
        const fact = make("div", name === "outcome" ? { class: "outcome" } : {});
        fact.append(make("dt", {}, name), make("dd", {}, value));
        return fact;
      }),
    );
    this.svg.setAttribute("aria-label", `The roads from above: ${this.title}`);
    this.drawTable(moment);
    this.words = `${this.title}: ${Object.entries(facts).map((fact) => fact.join(" ")).join(", ")}`;
  }

  facts({ ego, claims, outcome }, frame) {
    const time_s = Math.min(frame, this.episode.frames - 1) * this.step_s;
    const facts = {
      time: `${time_s.toFixed(1)} s`,
      speed: `${ego.speed_mps.toFixed(1)} m/s`,
      action: ego.desired_mps === null ? "none yet" : `wants ${ego.desired_mps.toFixed(1)} m/s`,
      value: ego.value === null ? "none" : ego.value.toFixed(2),
      claims: claims.join(", ") || "no lane",
      "safety check": ego.held ? "holds the ego" : "lets it drive",
      ...townFacts(ego),
    };
    return outcome ? { ...facts, outcome } : { ...facts, outcome: "still open" };
  }

  drawTable({ vehicles }) {
    if (!this.details.open) return;
    const lines = vehicles.map((one) => [
      one.number,
      one.trait,
      inferredWords(one.p_conservative) || "nothing",
      one.attention === null ? "none" : `${percent(one.attention)} %`,
      one.brakes ? "brakes" : "no",
      one.seen ? "yes" : "no",
    ]);
    const columns = ["vehicle", "true trait", "taken for", "attention", "brakes", "seen"];
    const head = make("tr", { class: "head" });
    head.append(...columns.map((name) => make("th", { scope: "col" }, name)));
    const rows = lines.map((line) => {
      const row = make("tr");
      row.append(...line.map((cell, column) => make(column ? "td" : "th", column ? { "data-column": columns[column] } : { scope: "row" }, cell)));
      return row;
    });
    this.table.replaceChildren(head, ...rows);
  }
}

class Player {
  constructor(contents) {
    this.contents = contents;
    this.panes = [...document.querySelectorAll(".pane")].map((element) => new Pane(element, contents));
    this.frame = 0;
    this.playing = false;
    this.listen();
  }

  get frames() {
    return Math.max(...this.panes.map((pane) => pane.episode?.frames ?? 1));
  }

  listen() {
    const [first, second] = this.panes;
    first.method.addEventListener("change", () => this.load());
    second.method.addEventListener("change", () => this.load());
    byId("case").addEventListener("change", () => this.load());
    byId("play").addEventListener("click", () => this.toggle());
    byId("to-start").addEventListener("click", () => this.show(0));
    byId("back").addEventListener("click", () => this.show(this.frame - 1));
    byId("forward").addEventListener("click", () => this.show(this.frame + 1));
    byId("to-end").addEventListener("click", () => this.show(this.frames - 1));
    byId("frame").addEventListener("input", () => this.show(Number(byId("frame").value)));
    byId("theatre").addEventListener("keydown", (event) => this.key(event));
    for (const pane of this.panes) pane.details.addEventListener("toggle", () => pane.draw(this.frame));
    for (const button of document.querySelectorAll("#failures button")) {
      button.addEventListener("click", () => this.open(button.dataset.policy, button.dataset.case));
    }
  }

  key(event) {
    const { key, target } = event;
    const steps = { ArrowLeft: this.frame - 1, ArrowRight: this.frame + 1, Home: 0, End: this.frames - 1 };
    if (event.altKey || event.ctrlKey || event.metaKey || target.matches("select, .scrolls")) return;
    if (key === " " && target.matches("button, summary")) return;
    if (key === " ") this.toggle();
    else if (key in steps) this.show(steps[key]);
    else return;
    event.preventDefault();
  }

  // Show a policy's case from its beginning, and go there.
  async open(label, number) {
    this.panes[0].method.value = label;
    await this.load(number);
    byId("theatre").scrollIntoView({ block: "start" });
    byId("stage").focus({ preventScroll: true });
  }

  // Load the chosen episodes, and offer the cases of the first one.
  async load(number = byId("case").value) {
    this.pause();
    const policy = this.contents.policies.find((one) => one.label === this.panes[0].method.value);
    const options = Object.entries(policy.outcomes).map(([one, outcome]) => make("option", { value: one }, `${one}: ${outcome}`));
    byId("case").replaceChildren(...options);
    if (number in policy.outcomes) byId("case").value = number;
    const loading = (this.loading = Promise.all(this.panes.map((pane) => pane.load(byId("case").value))));
    byId("theatre").setAttribute("aria-busy", "true");
    await loading;
    if (this.loading !== loading) return; // something else was chosen meanwhile
    byId("theatre").setAttribute("aria-busy", "false");
    byId("frame").max = this.frames - 1;
    this.show(0);
  }

  // Draw a frame and, unless it plays, say what is there.
  show(frame, isPlaying = false) {
    if (!isPlaying) this.pause();
    this.frame = Math.max(0, Math.min(frame, this.frames - 1));
    for (const pane of this.panes) pane.draw(this.frame);
    const step_s = this.panes[0].step_s;
    const clock = `${(this.frame * step_s).toFixed(1)} of ${((this.frames - 1) * step_s).toFixed(1)} s`;
    byId("frame").value = this.frame;
    byId("frame").setAttribute("aria-valuetext", clock);
    byId("clock").textContent = clock;
    if (!isPlaying) this.say("");
  }

  say(before) {
    const words = this.panes.filter((pane) => pane.episode).map((pane) => pane.words);
    byId("player-status").textContent = `${before}${words.join("; ")}`;
  }

  toggle() {
    if (this.playing) {
      this.pause();
      this.say("Paused. ");
      return;
    }
    if (this.frame === this.frames - 1) this.show(0);
    this.playing = true;
    byId("play").textContent = "Pause";
    byId("player-status").textContent = "Playing";
    const from = this.frame;
    const began = performance.now();
    const tick = (now) => {
      if (!this.playing || this.began !== began) return;
      const passed_s = ((now - began) / 1000) * Number(byId("speed").value);
      const frame = from + Math.max(0, Math.floor(passed_s / this.panes[0].step_s));
      if (frame >= this.frames - 1) this.show(this.frames - 1);
      else {
        if (frame !== this.frame) this.show(frame, true);
        requestAnimationFrame(tick);
      }
    };
    this.began = began;
    requestAnimationFrame(tick);
  }

  pause() {
    this.playing = false;
    byId("play").textContent = "Play";
  }
}

const playerContents = readJson("player-data");
if (playerContents) {
  const player = new Player(playerContents);
  player.panes[0].method.value = playerContents.opening;
  player.load().then(() => performance.mark("player-drawn"));
}
