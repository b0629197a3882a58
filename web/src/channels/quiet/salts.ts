/** The Gaussians that serve as the salt of Argon2id; see docs/byte-layout.md, "From a key to a data key". */
import { sha256 } from '@noble/hashes/sha2.js';
import { ascii, joined } from '../../core/bytes.ts';
import { coarseLength, type Fields, GEOMETRY, ID_BYTES, UNIT_TOLERANCE } from './bits.ts';

export const SALTS = 12;
const LABEL = ascii('keyss/v2/salt');
const EQUAL_HARMONICS = 2; // pairs of one colour that make a Gaussian doubtful

/** Up to 12 salts of 16 bytes, the likeliest first; `low` has rows of `size` bytes. */
export function salts(fields: Fields, ids: Uint8Array, low: Uint8Array, size: number): Uint8Array[] {
  const ranks = new Uint16Array(fields.count);
  for (let row = 0; row < fields.count; row++) ranks[row] = rank(fields, row);
  const compare = (a: number, b: number): number =>
    ranks[a] - ranks[b] ||
    compared(ids, a, b, ID_BYTES) ||
    compared(low, a, b, size);
  const order = Array.from(ranks.keys()).sort(compare);
  return order.slice(0, SALTS).map((row) =>
    saltOf(ids.subarray(row * ID_BYTES, (row + 1) * ID_BYTES), low.subarray(row * size, (row + 1) * size)),
  );
}

/** The salt of one carrier. */
export function saltOf(id: Uint8Array, low: Uint8Array): Uint8Array {
  return sha256(joined(LABEL, id, low)).slice(0, 16);
}

function compared(rows: Uint8Array, a: number, b: number, width: number): number {
  for (let at = 0; at < width; at++) {
    const difference = rows[a * width + at] - rows[b * width + at];
    if (difference) return difference;
  }
  return 0;
}

/** 0 to 511: 256 for a doubtful Gaussian, and less the larger its least harmonic is. */
function rank(fields: Fields, row: number): number {
  const { width, words, masks } = fields;
  const at = row * width;
  let least = 255;
  for (let field = width > GEOMETRY ? GEOMETRY : 0; field < width; field++) {
    if (width > GEOMETRY || masks[field]) least = Math.min(least, (words[at + field] >>> 23) & 255);
  }
  return (isDoubtful(fields, at) ? 256 : 0) | (255 - least);
}

function isDoubtful(fields: Fields, at: number): boolean {
  const { width, words, masks, quatsInUse } = fields;
  for (let field = 0; field < width; field++) {
    const word = words[at + field];
    if (!masks[field]) continue;
    if (((word >>> 23) & 255) === 0 || (word & 0x7ffffe & ~masks[field]) === 0) return true;
  }
  if (quatsInUse && Math.abs(coarseLength(words, at) - 1) < UNIT_TOLERANCE) return true;
  const high = (field: number): number =>
    (words[at + field] & 0x7fffffff) >>> (field < GEOMETRY ? 9 : 13);
  const near = (first: number, count: number): boolean => {
    for (let a = first; a < first + count; a++) {
      for (let b = a + 1; b < first + count; b++) {
        if (Math.abs(high(a) - high(b)) <= 1) return true;
      }
    }
    return false;
  };
  if (near(0, 3) || (quatsInUse && near(3, 4))) return true;
  for (let field = GEOMETRY; field < width; field += 3) if (near(field, 3)) return true;
  let equal = 0;
  for (let colour = 0; colour < 3; colour++) {
    const values: number[] = [];
    for (let field = GEOMETRY + colour; field < width; field += 3) values.push(high(field));
    values.sort((a, b) => a - b);
    for (let index = 1; index < values.length; index++) equal += Number(values[index] === values[index - 1]);
  }
  return equal >= EQUAL_HARMONICS;
}
