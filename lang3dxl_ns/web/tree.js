// The tree of chunks of a large scene, as levels.py makes it: chunk 0 is the whole scene, coarsely.

export const FAN = 4; // children of a chunk, each of which shows a quarter of its rows in more detail

/** Return a function from a chunk's rows to the rows of chunk 0 that stand for them. rows: of each chunk. */
export function ancestry(number, rows) {
  let level = 0, first = 0;
  while (number >= first + FAN ** level) first += FAN ** level++;
  const start = (number - first) * rows, size = FAN ** level;
  return (i) => Math.floor((start + i) / size);
}
