/** Orders of numbers. */

/** The rows [N] by words of 32 bits, the last of which counts most; equal ones in their order. */
export function sortingOrder(...words: Uint32Array[]): Uint32Array {
  return order(words[0].length, words, 1);
}

/** The same by numbers of 64 bits [2 N], each as its low and its high 32 bits beside each other. */
export function sortingOrderOfPairs(words: Uint32Array): Uint32Array {
  return order(words.length >> 1, [words, words.subarray(1)], 2);
}

/** Radix sort, 16 bits at a time, by every `step`th word of each column. */
function order(count: number, columns: readonly Uint32Array[], step: number): Uint32Array {
  let [rows, next] = [new Uint32Array(count), new Uint32Array(count)];
  for (let row = 0; row < count; row++) rows[row] = row;
  for (const column of columns) {
    for (const shift of [0, 16]) {
      const starts = new Uint32Array(65537);
      for (let row = 0; row < count; row++) starts[((column[row * step] >>> shift) & 0xffff) + 1]++;
      for (let digit = 0; digit < 65536; digit++) starts[digit + 1] += starts[digit];
      for (let at = 0; at < count; at++) {
        const row = rows[at];
        next[starts[(column[row * step] >>> shift) & 0xffff]++] = row;
      }
      [rows, next] = [next, rows];
    }
  }
  return rows;
}
