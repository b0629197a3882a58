import { rowsOf } from './bytes.ts';

/** N Gaussians in the raw parameterisation of the 3DGS .ply, all float32. */
export interface Gaussians {
  readonly count: number;
  readonly shDegree: number; // 0 to 3
  readonly means: Float32Array; // [N, 3]
  readonly quats: Float32Array; // [N, 4] wxyz, of any length
  readonly logScales: Float32Array; // [N, 3] natural logarithms
  readonly opacityLogits: Float32Array; // [N]
  readonly sh: Float32Array; // [N, K, 3], K = (shDegree + 1)^2
}

/** Columns whose width does not depend on the SH degree. */
const FIXED = ['means', 'quats', 'logScales', 'opacityLogits'] as const;
export const COLUMNS = [...FIXED, 'sh'] as const;

export function coefficients(shDegree: number): number {
  return (shDegree + 1) ** 2;
}

/** `count` Gaussians of zeros. */
export function emptyGaussians(count: number, shDegree: number): Gaussians {
  return {
    count,
    shDegree,
    means: new Float32Array(3 * count),
    quats: new Float32Array(4 * count),
    logScales: new Float32Array(3 * count),
    opacityLogits: new Float32Array(count),
    sh: new Float32Array(3 * coefficients(shDegree) * count),
  };
}

/** The buffers, to be transferred between threads. */
export function buffersOf(gaussians: Gaussians): ArrayBuffer[] {
  return COLUMNS.map((column) => gaussians[column].buffer as ArrayBuffer);
}

/** A copy with another SH degree: truncated, or padded with zeros. */
export function withDegree(gaussians: Gaussians, shDegree: number): Gaussians {
  const copy = emptyGaussians(gaussians.count, shDegree);
  for (const column of FIXED) copy[column].set(gaussians[column]);
  const [from, to] = [3 * coefficients(gaussians.shDegree), 3 * coefficients(shDegree)];
  for (let row = 0; row < gaussians.count; row++) {
    for (let at = 0; at < Math.min(from, to); at++) copy.sh[row * to + at] = gaussians.sh[row * from + at];
  }
  return copy;
}

/** The Gaussians of these rows, in this order. */
export function selected(gaussians: Gaussians, rows: ArrayLike<number>): Gaussians {
  const selection = emptyGaussians(rows.length, gaussians.shDegree);
  for (const column of COLUMNS) {
    selection[column].set(rowsOf(gaussians[column], rows, gaussians[column].length / Math.max(1, gaussians.count)));
  }
  return selection;
}

/** The Gaussians for which `keep` is true, in their order. */
export function where(gaussians: Gaussians, keep: (row: number) => boolean): Gaussians {
  const rows: number[] = [];
  for (let row = 0; row < gaussians.count; row++) if (keep(row)) rows.push(row);
  return rows.length === gaussians.count ? gaussians : selected(gaussians, rows);
}

export function opacity(logit: number): number {
  return 1 / (1 + Math.exp(-logit));
}

/** Whether there are at most 256 different opacities, as in models decoded from other formats. */
export function opacitiesAreBytes(gaussians: Gaussians): boolean {
  const different = new Set<number>();
  return gaussians.opacityLogits.every((logit) => different.add(logit).size <= 256);
}

/** The `count` most visible Gaussians by opacity and cross-section, in their order. */
export function mostVisible(gaussians: Gaussians, count: number): Gaussians {
  const visibility = Float32Array.from({ length: gaussians.count }, (_, row) => {
    const [a, b, c] = gaussians.logScales.subarray(3 * row, 3 * row + 3);
    return opacity(gaussians.opacityLogits[row]) * Math.exp(a + b + c - Math.min(a, b, c));
  });
  const least = Float32Array.from(visibility).sort()[Math.max(0, gaussians.count - count)];
  let left = count;
  return where(gaussians, (row) => visibility[row] >= least && left-- > 0);
}
