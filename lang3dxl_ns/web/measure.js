// Lengths in meters, where the photos' GPS or a length that one types tells them; the scale bar and north.
import { dot } from "./answer.js";
import { $ } from "./cards.js";

const WIDEST = 120, ROUND = [5, 2, 1], NEAR = 0.03; // pixels of the scale bar; first digits of its length; share of a landmark's height that is the ground
const length = (vector) => Math.hypot(...vector);
const between = ([a, b]) => b.map((value, axis) => value - a[axis]);

/** Return the length of the scene's unit in meters, as { meters, uncertainty }; null where nothing tells it.
 * about: the page's description; its `unit` is what `setLength` found. */
const metersOf = ({ unit, meters }) => (unit ? { meters: unit, uncertainty: null } : meters);

/** Write a length: in meters, or else as a share of the landmark's height, which `inShares` tells. */
export function lengthAsText(units, about) {
  const known = metersOf(about), [ground, top] = about.heights;
  if (!known) return `${Number(((100 * units) / (top - ground)).toPrecision(2))} %`;
  const size = units * known.meters, digits = Number(size.toPrecision(3));
  return size >= 1 ? `${digits} m` : `${Number((100 * size).toPrecision(3))} cm`;
}

export const inShares = (about) => (metersOf(about) ? "" : " (shares of the landmark's height)");

/** Tell how high a point lies above the ground. */
export function heightAsText(point, about) {
  const [ground, top] = about.heights, rise = dot(about.up, point) - ground;
  return rise < NEAR * (top - ground) ? "on the ground" : `${lengthAsText(rise, about)} above the ground`;
}

/** Tell how far two points are apart, and how much higher one is. */
export function distanceAsText(ends, about) {
  const apart = between(ends), known = metersOf(about), rise = Math.abs(dot(apart, about.up));
  const gps = known?.uncertainty && ` (± ${Math.round(100 * known.uncertainty)} %, by the photos' GPS)`;
  const sure = known ? gps || ", by the length that was typed" : `${inShares(about)}; the photos tell no meters, but you can type the length`;
  return `${lengthAsText(length(apart), about)} apart, one ${lengthAsText(rise, about)} higher${sure}.`;
}

/** Set the scale of the page by two points and the meters between them. Without meters, it is the photos' again. */
export function setLength(about, ends, meters) {
  const unit = meters / length(between(ends));
  about.unit = Number.isFinite(unit) && unit > 0 ? Number(unit.toPrecision(5)) : null;
}

/** Draw a scale bar, which holds at the point that the eye turns around, and an arrow to the north. */
export function drawScale(about, { camera, controls, frame }) {
  const known = metersOf(about), e = camera.matrixWorld.elements;
  $("scale").hidden = !known;
  if (!known) return;
  const distance = camera.position.distanceTo(controls.target), half = (camera.fov * Math.PI) / 360;
  const pixels = frame.clientHeight / 2 / Math.tan(half) / distance / known.meters; // of a meter
  const decade = 10 ** Math.floor(Math.log10(WIDEST / pixels)), meters = decade * ROUND.find((digit) => digit * decade * pixels <= WIDEST);
  $("bar").style.width = `${meters * pixels}px`;
  $("bar").textContent = lengthAsText(meters / known.meters, about);
  const north = about.meters?.north;
  $("north").hidden = !north;
  if (!north) return;
  const [x, y, z] = about.up, [a, b, c] = [e[0], e[1], e[2]], ahead = [y * c - z * b, z * a - x * c, x * b - y * a]; // up × right
  $("north").style.transform = `rotate(${Math.atan2(dot([a, b, c], north), dot(ahead, north))}rad)`;
}
