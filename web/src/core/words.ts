/** 64-bit integers as pairs of low and high 32 bits, little-endian [2 N]; many times faster than BigInt. */
export type Words = Uint32Array;

/** The words of little-endian bytes, which must be aligned to four bytes. */
export function wordsOf(bytes: Uint8Array): Words {
  return new Uint32Array(bytes.buffer, bytes.byteOffset, bytes.length >> 2);
}

/** Stable ascending order [N] of `words` [N, width], last column most significant. Radix sort by 16 bits. */
export function sortingOrder(words: Uint32Array, width = 2): Uint32Array {
  const count = words.length / width;
  let [rows, next] = [new Uint32Array(count), new Uint32Array(count)];
  for (let row = 0; row < count; row++) rows[row] = row;
  for (let bits = 0; bits < 32 * width; bits += 16) {
    const [column, shift] = [bits >> 5, bits & 31];
    const starts = new Uint32Array(65537);
    for (let row = 0; row < count; row++) starts[((words[row * width + column] >>> shift) & 0xffff) + 1]++;
    for (let digit = 0; digit < 65536; digit++) starts[digit + 1] += starts[digit];
    for (let at = 0; at < count; at++) {
      const row = rows[at];
      next[starts[(words[row * width + column] >>> shift) & 0xffff]++] = row;
    }
    [rows, next] = [next, rows];
  }
  return rows;
}

/** [N] number of words equal to each, itself included; `order`: their sorting order. */
export function multiplicities(words: Words, order = sortingOrder(words)): Uint32Array {
  const counts = new Uint32Array(order.length);
  for (let start = 0, end = 0; start < order.length; start = end) {
    const [low, high] = [words[2 * order[start]], words[2 * order[start] + 1]];
    while (end < order.length && words[2 * order[end]] === low && words[2 * order[end] + 1] === high) end++;
    for (let at = start; at < end; at++) counts[order[at]] = end - start;
  }
  return counts;
}

/** Replaces the word at `at` by its hash, the finaliser of splitmix64 (Steele et al. 2014); no secret is involved. */
function mixAt(words: Words, at: number): void {
  let low = words[2 * at] + 0x7f4a7c15;
  let high = (words[2 * at + 1] + 0x9e3779b9 + (low > 0xffffffff ? 1 : 0)) >>> 0;
  low >>>= 0;
  for (let round = 0; round < 2; round++) {
    const shift = round ? 27 : 30;
    low ^= (low >>> shift) | (high << (32 - shift));
    high ^= high >>> shift;
    const [byLow, byHigh] = round ? [0x133111eb, 0x94d049bb] : [0x1ce4e5b9, 0xbf58476d];
    high = Math.imul(high, byLow) + Math.imul(low, byHigh) + highProduct(low >>> 0, byLow);
    low = Math.imul(low, byLow);
  }
  words[2 * at] = low ^ ((low >>> 31) | (high << 1));
  words[2 * at + 1] = high ^ (high >>> 31);
}

const SCRATCH = new Uint32Array(2);

/** The hash of one word, in a buffer that the next call overwrites. */
export function mix(low: number, high = 0): Words {
  SCRATCH[0] = low;
  SCRATCH[1] = high;
  mixAt(SCRATCH, 0);
  return SCRATCH;
}

/** Hashes all words in place; returns them. */
export function mixed(words: Words): Words {
  for (let at = 0; at < words.length >> 1; at++) mixAt(words, at);
  return words;
}

/** The high 32 bits of the product of two numbers of 32 bits. */
export function highProduct(a: number, b: number): number {
  const [a0, a1, b0, b1] = [a & 0xffff, a >>> 16, b & 0xffff, b >>> 16];
  const middle = a1 * b0 + ((a0 * b0) >>> 16);
  return a1 * b1 + Math.floor(middle / 0x10000) + ((a0 * b1 + (middle & 0xffff)) >>> 16);
}
