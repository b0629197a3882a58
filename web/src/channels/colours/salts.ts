/** The Gaussians that serve as salts of Argon2id; `keyss.channels.colours.salts` on the other side. */
import { sha256 } from '@noble/hashes/sha2.js';
import { ascii, bytesKey, joined } from '../../core/bytes.ts';
import { runs, sortingOrder } from '../../core/words.ts';
import { SALT_BYTES } from '../../keys/keys.ts';
import { COLOUR_NOISE, COLOUR_STEP, NAME, type Numbers, OPACITY_NOISE, OPACITY_STEP, SCALE_STEP } from './carriers.ts';
import { rank } from './lattice.ts';

const SALTS = 16; // at most
const BANDS = [0.08, 0.4, 1.01]; // limits of two bands of opacity, with half of the salts each
const STEPS = [16, 8, 8, 5, 5, 5]; // of opacity, two ratios of scales, red, green and blue that make a cell
const NOISE = [
  OPACITY_NOISE / OPACITY_STEP, 1, 1,
  ...[COLOUR_NOISE / COLOUR_STEP, COLOUR_NOISE / COLOUR_STEP, COLOUR_NOISE / COLOUR_STEP],
];
const UNCHANGED = 4; // of these numbers: opacity, ratios and red
const MAX_CELLS = 30_000;
const LABEL = ascii('keyss/v1/colours-salt');
const PUBLIC = sha256(LABEL);

/** Up to 16 salts of 16 bytes. */
export function saltsOf(numbers: Numbers): Uint8Array[] {
  const cells = new Int16Array(STEPS.length * numbers.count);
  const stable: number[][] = BANDS.slice(1).map(() => []);
  for (let row = 0; row < numbers.count; row++) {
    const inner = putCells(numbers, row, cells);
    const band = BANDS.findIndex((least) => numbers.opacities[row] <= least) - 1;
    if (inner && band >= 0) stable[band].push(row);
  }
  const salts = new Map<string, Uint8Array>();
  for (const rows of stable) {
    const names = new Int16Array(NAME * rows.length);
    rows.forEach((row, to) => {
      names.set(cells.subarray(STEPS.length * row, STEPS.length * row + UNCHANGED), NAME * to);
    });
    const ranks = rank(PUBLIC, 'salt', names);
    const order = sortingOrder(ranks);
    for (const start of runs(ranks, order).slice(0, -1).slice(0, SALTS / stable.length)) {
      const row = rows[order[start]];
      const own = cells.slice(STEPS.length * row, STEPS.length * (row + 1));
      const salt = sha256(joined(LABEL, new Uint8Array(own.buffer))).slice(0, SALT_BYTES);
      salts.set(bytesKey(salt), salt);
    }
  }
  return [...salts.values()];
}

/** Writes the cells of a Gaussian; whether those that writing leaves alone are where no format moves them out. */
function putCells({ logScales, opacities, colours }: Numbers, row: number, cells: Int16Array): boolean {
  const steps = [
    opacities[row] / OPACITY_STEP - 0.5,
    (logScales[3 * row + 1] - logScales[3 * row]) / SCALE_STEP - 0.5,
    (logScales[3 * row + 2] - logScales[3 * row + 1]) / SCALE_STEP - 0.5,
    ...[0, 1, 2].map((colour) => colours[3 * row + colour] / COLOUR_STEP),
  ];
  let inner = true;
  steps.forEach((step, column) => {
    const place = Math.max(-MAX_CELLS, Math.min(MAX_CELLS, step / STEPS[column]));
    const cell = Math.floor(place);
    cells[STEPS.length * row + column] = cell;
    const outward = Math.abs(place - cell - 0.5) / (0.5 - NOISE[column] / STEPS[column]);
    if (column < UNCHANGED && outward >= 1) inner = false;
  });
  return inner;
}
