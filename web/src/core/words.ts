import { sortingOrderOfPairs } from './sorting.ts';

/**
 * Numbers of 64 bits, as their low and their high 32 bits beside each other in a Uint32Array [2 N]: as the bytes of a
 * stream are read on every machine that has a browser, and many times faster than BigInt.
 */
export type Words = Uint32Array;

/** The words of little-endian bytes, which have to begin at a multiple of four. */
export function wordsOf(bytes: Uint8Array): Words {
  return new Uint32Array(bytes.buffer, bytes.byteOffset, bytes.length >> 2);
}

/** [N] how many of the words are equal to each, itself included. */
export function namesakes(words: Words): Uint32Array {
  const order = sortingOrderOfPairs(words);
  const found = new Uint32Array(order.length);
  for (let first = 0, end = 0; first < order.length; first = end) {
    while (end < order.length && same(words, order[first], order[end])) end++;
    for (let at = first; at < end; at++) found[order[at]] = end - first;
  }
  return found;
}

/** Whether two of the words are equal. */
export function same(words: Words, a: number, b: number): boolean {
  return words[2 * a] === words[2 * b] && words[2 * a + 1] === words[2 * b + 1];
}
