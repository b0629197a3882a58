/** Orders of numbers. */

/** The rows [N] by words of 32 bits, the last of which counts most; equal ones in their order. */
export function sortingOrder(...words: Uint32Array[]): Uint32Array {
  const count = words[0].length;
  let [rows, next] = [new Uint32Array(count), new Uint32Array(count)];
  for (let row = 0; row < count; row++) rows[row] = row;
  for (const word of words) {
    for (const shift of [0, 16]) { // radix sort
      const starts = new Uint32Array(65537);
      for (let row = 0; row < count; row++) starts[((word[row] >>> shift) & 0xffff) + 1]++;
      for (let digit = 0; digit < 65536; digit++) starts[digit + 1] += starts[digit];
      for (let at = 0; at < count; at++) next[starts[(word[rows[at]] >>> shift) & 0xffff]++] = rows[at];
      [rows, next] = [next, rows];
    }
  }
  return rows;
}
