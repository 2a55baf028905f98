// Distances between places that one clicks, in meters where the photos' GPS tells them.

const length = (vector) => Math.hypot(...vector);

/** Write a length of the scene's frame. meters: { meters: length of the unit, uncertainty } or null. */
export function lengthAsText(units, meters) {
  if (!meters) return `${units.toPrecision(3)} units`;
  const size = units * meters.meters, digits = Number(size.toPrecision(3));
  return size >= 1 ? `${digits} m` : `${Number((100 * size).toPrecision(3))} cm`;
}

/** Tell how far two points are apart, and how much higher one is. */
export function distanceAsText([a, b], { meters, up }) {
  const apart = b.map((value, axis) => value - a[axis]), above = meters?.up ?? up;
  const rise = Math.abs(apart.reduce((sum, value, axis) => sum + value * above[axis], 0));
  const sure = meters ? ` (± ${Math.round(100 * meters.uncertainty)} %, by the photos' GPS)` : "; the photos tell no meters";
  return `${lengthAsText(length(apart), meters)} apart, ${lengthAsText(rise, meters)} of it in height${sure}.`;
}
