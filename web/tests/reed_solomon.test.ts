/** Codewords made with slow arithmetic, with losses and errors. */
import { expect, test } from 'vitest';
import { decoded, type Shards } from '../src/channels/reed_solomon.ts';
import { joined } from '../src/core/bytes.ts';
import { random } from './vectors.ts';

function product(a: number, b: number): number {
  let sum = 0;
  for (let bit = 15; bit >= 0; bit--) sum = (sum << 1) ^ (sum & 0x8000 ? 0x1100b : 0) ^ ((b >> bit) & 1 ? a : 0);
  return sum;
}

/** Sums of a Cantor basis in the order of their binary numbers. */
const points = [0];
for (let basis = 1; points.length < 256; ) {
  points.push(...points.map((each) => each ^ basis));
  let root = 0;
  while ((product(root, root) ^ root) !== basis) root++;
  basis = root;
}

/** Shards of two columns: values of polynomials with random coefficients. */
function shardsOf(n: number, k: number, draw: () => number): Uint8Array[] {
  const polynomials = [0, 1].map(() => Array.from({ length: k }, () => Math.floor(65536 * draw())));
  return Array.from({ length: n }, (_, row) => {
    const values = polynomials.map((each) => each.reduce((value, coefficient) => product(value, points[row]) ^ coefficient, 0));
    return Uint8Array.from(values.flatMap((value) => [value >> 8, value & 255]));
  });
}

const together = (shards: [number, Uint8Array][]): Shards => ({
  numbers: shards.map(([number]) => number), data: joined(...shards.map(([, shard]) => shard)),
});

test.each([[1, 9, 3, 2], [12, 40, 9, 10], [100, 180, 20, 40], [30, 30, 0, 0]])(
  '%i of %i shards, %i wrong and %i lost',
  (k, n, wrong, lost) => {
    const draw = random(k);
    const two = [shardsOf(n, k, draw), shardsOf(n, k, draw)];
    const numbered = two.flatMap((shards, codeword) =>
      shards.map((shard, row): [number, Uint8Array] => [2 * row + codeword, shard]).slice(codeword ? 0 : lost),
    );
    const seen = numbered.map(([number, shard], at): [number, Uint8Array] => [
      number, at < wrong ? shard.map((each) => each ^ 77) : shard,
    ]);
    const data = decoded({ count: 2, n, k, width: 4 }, together(seen.reverse()), wrong > 0);
    const expected = Array.from({ length: k }, (_, row) => two.map((shards) => [...shards[row]])).flat(2);
    expect([...data]).toEqual(expected);
    if (lost) expect(() => decoded({ count: 2, n, k, width: 4 }, together(seen.slice(0, 2 * k - 1)))).toThrow(/^The key is right/);
  },
);
