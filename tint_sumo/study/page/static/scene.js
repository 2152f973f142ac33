// The roads from above with all vehicles, at one frame of an episode. Lengths are in m; y leads down, as in SVG.

class SceneView {
  constructor(svg, shapes) {
    this.shapes = shapes;
    svg.setAttribute("viewBox", shapes.view.join(" "));
    this.routes = Object.fromEntries(
      Object.entries(shapes.routes).map(([name, path]) => [
        name,
        makeSvg("path", { class: "route", d: path, "stroke-width": shapes.lane_width_m }),
      ]),
    );
    this.halos = makeSvg("g");
    this.vehicles = makeSvg("g");
    svg.replaceChildren(
      makeSvg("path", { class: "roads", d: shapes.roads, "fill-rule": "evenodd" }),
      ...Object.values(this.routes),
      makeSvg("path", { class: "borders", d: shapes.borders }),
      makeSvg("path", { class: "way", d: shapes.way }),
      this.halos,
      this.vehicles,
    );
  }

  draw(moment) {
    for (const [name, route] of Object.entries(this.routes)) route.classList.toggle("claimed", moment.claims.includes(name));
    const weighty = moment.vehicles.filter((one) => one.attention >= this.shapes.least_weight);
    this.halos.replaceChildren(...weighty.map((one) => this.halo(one)));
    this.vehicles.replaceChildren(...moment.vehicles.map((one) => this.driver(one)), this.box(moment.ego, "ego", "E"));
  }

  halo(one) {
    const [least, most] = this.shapes.halo_m;
    const radius = least + (most - least) * Math.sqrt(one.attention);
    return makeSvg("circle", { class: "halo", cx: one.x_m, cy: -one.y_m, r: radius });
  }

  driver(one) {
    const box = this.box(one, `driver trait${one.kind}`, one.kind ? "A" : "C");
    box.querySelector(".body").style.fill = inferredColour(one.p_conservative);
    box.classList.toggle("hatched", one.p_conservative !== null && one.p_conservative < 0.5);
    box.classList.toggle("hidden", !one.seen);
    const words = `${inferredWords(one.p_conservative, ", taken for ")}${one.seen ? "" : ", not seen"}`;
    box.append(makeSvg("title", {}, `vehicle ${one.number}: ${one.trait}${words}`));
    return box;
  }

  box(one, name, letter) {
    const { length_m: length, width_m: width } = this.shapes.vehicle;
    const edge = 0.14; // half of the outline, which lies inside
    const group = makeSvg("g", {
      class: `${name}${one.brakes ? " braking" : ""}`,
      transform: `translate(${one.x_m} ${-one.y_m}) rotate(${-one.heading_deg})`,
    });
    const body = { x: -length / 2 + edge, y: -width / 2 + edge, width: length - 2 * edge, height: width - 2 * edge, rx: 0.3 };
    const lamp = { class: "lamp", x: -length / 2 - 0.45, width: 0.45, height: 0.6 };
    group.append(
      makeSvg("rect", { class: "body", ...body }),
      makeSvg("rect", { class: "hatch", ...body }),
      makeSvg("rect", { class: "glass", x: 0.3 * length, y: -0.36 * width, width: 0.1 * length, height: 0.72 * width }),
      makeSvg("rect", { ...lamp, y: -width / 2 }),
      makeSvg("rect", { ...lamp, y: width / 2 - 0.6 }),
      makeSvg("text", { class: "letter", transform: `rotate(${one.heading_deg})` }, letter),
    );
    return group;
  }
}

// A share in percent, as percentages.py writes it: only all of something reads 100, and only nothing of it 0.
const percent = (share) => {
  const rounded = Math.round(100 * share);
  if (rounded >= 100 && share < 1) return ">99";
  if (rounded <= 0 && share > 0) return "<1";
  return `${rounded}`;
};

// The colour of the likelier trait, the greyer the less sure.
const inferredColour = (pConservative) => {
  if (pConservative === null) return "var(--unknown)";
  const trait = pConservative > 0.5 ? "conservative" : "aggressive";
  return `color-mix(in srgb, var(--${trait}) ${Math.round(100 * Math.abs(2 * pConservative - 1))}%, var(--unsure))`;
};

const inferredWords = (pConservative, before = "") => {
  if (pConservative === null) return "";
  const isConservative = pConservative > 0.5;
  const probability = isConservative ? pConservative : 1 - pConservative;
  return `${before}${isConservative ? "conservative" : "aggressive"}, ${percent(probability)} %`;
};
