// Colours: those of the page's style, and one for each robot.

const NAMES = ["cell", "line", "wall", "box", "boxedge", "shut", "pending", "ink", "quiet", "accent", "good", "warn", "bad", "paper", "zone", "heat", "truth", "person"];

// The style's colours as texts such as #1b2330.
export function readColours(style = getComputedStyle(document.documentElement)) {
  return Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

// The parts of a colour such as #1b2330, 0 to 255.
export function rgb(text) {
  return [1, 3, 5].map((start) => parseInt(text.slice(start, start + 2), 16) || 0);
}

// A fixed colour for each robot: chosen ones for the first, then hues spread by the golden angle.
const CHOSEN = ["#2a7de1", "#d9480f", "#0f9d76", "#9c36b5", "#c2255c", "#5f7d0e", "#0b7285", "#7048e8"];
const SATURATION = 0.65;
const LIGHTNESS = 0.48;
const known = new Map();

export function rgbOf(id) {
  let found = known.get(id);
  if (!found) {
    const number = Number(id.replace(/\D+/g, "")) || [...id].reduce((sum, c) => sum + c.charCodeAt(0), 0);
    found = CHOSEN[number - 1] ? rgb(CHOSEN[number - 1]) : ofHue((205 + number * 137.508) % 360);
    known.set(id, found);
  }
  return found;
}

export function colourOf(id) {
  return `rgb(${rgbOf(id).join(" ")})`;
}

// https://www.w3.org/TR/css-color-4/#hsl-to-rgb
function ofHue(hue) {
  const part = (n) => {
    const k = (n + hue / 30) % 12;
    const a = SATURATION * Math.min(LIGHTNESS, 1 - LIGHTNESS);
    return Math.round(255 * (LIGHTNESS - a * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  };
  return [part(0), part(8), part(4)];
}
