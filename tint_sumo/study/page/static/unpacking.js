// Data that stand in the page, by their names.

const byId = (name) => document.getElementById(name);

const readJson = (name) => {
  const element = byId(name);
  return element ? JSON.parse(element.textContent) : null;
};

// Text that was compressed; see packed() in html.py.
const unpack = async (name) => {
  const bytes = Uint8Array.from(atob(byId(name).textContent), (character) => character.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
};

const make = (name, attributes = {}, text = "") => {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.textContent = text;
  return element;
};

const makeSvg = (name, attributes = {}, text = "") => {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.textContent = text;
  return element;
};
