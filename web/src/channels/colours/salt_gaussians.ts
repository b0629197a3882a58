/** Salts of Argon2id derived from Gaussians; counterpart of `keyss.channels.colours.salt_gaussians`. */
import { sha256 } from '@noble/hashes/sha2.js';
import { ascii, bytesKey, joined } from '../../core/bytes.ts';
import { SALT_BYTES } from '../../keys/keys.ts';
import {
  type Carriers, cellOf, COLOUR_NOISE, COLOUR_STEPS, fractions, OPACITY_NOISE, OPACITY_STEPS, SCALE_STEPS,
} from './carriers.ts';

const SALTS = 16; // at most
const BANDS = [0.08, 0.4, 1.01]; // limits of two opacity bands with half of the salts each
const [OPACITY_CELL, RATIO_CELL, COLOUR_CELL] = [16, 8, 5]; // steps
const LABEL = ascii('keyss/v1/colours-salt');

/** Up to 16 salts of 16 bytes. */
export function saltsOf({ count, logScales, opacities, colours }: Carriers): Uint8Array[] {
  const cells = new Int16Array(6 * count);
  const ids = new Int16Array(8 * count); // the first four cells, zero-padded to a block of AES
  const stable = Array.from({ length: count }, (_, row) => {
    const ratio = (axis: number) => (logScales[3 * row + axis + 1] - logScales[3 * row + axis]) * SCALE_STEPS - 0.5;
    const own = [
      cellOf(opacities[row] * OPACITY_STEPS - 0.5, OPACITY_CELL, OPACITY_NOISE),
      ...[0, 1].map((axis) => cellOf(ratio(axis), RATIO_CELL, 1)),
      ...[0, 1, 2].map((column) => cellOf(colours[3 * row + column] * COLOUR_STEPS, COLOUR_CELL, COLOUR_NOISE)),
    ];
    own.forEach(([cell], column) => (cells[6 * row + column] = cell));
    ids.set(cells.subarray(6 * row, 6 * row + 4), 8 * row);
    return own.slice(0, 4).every(([, errorProbability]) => errorProbability === 0);
  });
  const hashes = fractions(sha256(LABEL), 'salt', ids);
  const salts = new Map<string, Uint8Array>();
  BANDS.slice(1).forEach((high, band) => {
    const listed = new Map<number, number>(); // the first Gaussian with each hash
    opacities.forEach((each, row) => {
      const hash = hashes[2 * row];
      if (stable[row] && each > BANDS[band] && each <= high && !listed.has(hash)) listed.set(hash, row);
    });
    for (const [, row] of [...listed].sort(([a], [b]) => a - b).slice(0, SALTS / (BANDS.length - 1))) {
      const salt = sha256(joined(LABEL, new Uint8Array(cells.slice(6 * row, 6 * row + 6).buffer))).slice(0, SALT_BYTES);
      salts.set(bytesKey(salt), salt);
    }
  });
  return [...salts.values()];
}
