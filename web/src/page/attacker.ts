/** What somebody without the key can see: the published model, filtered and coloured by its numbers. */
import { coefficients, emptyGaussians, type Gaussians, opacity, selected } from '../core/gaussians.ts';

export const COLOURINGS = ['as it is', 'opacity', 'size', 'elongation', 'rotation', 'low bits'] as const;
export type Colouring = (typeof COLOURINGS)[number];

export interface Look {
  readonly threshold: number; // of opacity, 0 to 1
  readonly faintOnly: boolean; // those below the threshold, else those above it
  readonly opaque: boolean; // draw all that is left opaque
  readonly colouring: Colouring;
}

export const PLAIN: Look = { threshold: 0, faintOnly: false, opaque: false, colouring: 'as it is' };
const OPAQUE_LOGIT = 3;
const SH_C0 = 0.28209479177387814;

export function isPlain(look: Look): boolean {
  return !look.opaque && look.colouring === 'as it is' && (look.faintOnly ? false : look.threshold === 0);
}

/** The Gaussians that a look leaves, as it shows them. */
export function lookedAt(model: Gaussians, look: Look): Gaussians {
  if (isPlain(look)) return model;
  const rows: number[] = [];
  for (let row = 0; row < model.count; row++) {
    if (opacity(model.opacityLogits[row]) < look.threshold === look.faintOnly) rows.push(row);
  }
  const left = selected(model, rows);
  const shown = look.colouring === 'as it is' ? left : coloured(left, look.colouring);
  return look.opaque ? { ...shown, opacityLogits: shown.opacityLogits.map(() => OPAQUE_LOGIT) } : shown;
}

/** The same Gaussians, from blue over green to yellow by a number of theirs. */
function coloured(model: Gaussians, by: Colouring): Gaussians {
  const values = Float64Array.from({ length: model.count }, (_, row) => number(model, by, row));
  const sorted = Float64Array.from(values).sort();
  const [low, high] = [0.02, 0.98].map((share) => sorted[Math.floor(share * (sorted.length - 1))] ?? 0);
  const found = { ...emptyGaussians(model.count, 0), ...model, shDegree: 0, sh: new Float32Array(3 * model.count) };
  for (let row = 0; row < model.count; row++) {
    const share = Math.min(1, Math.max(0, (values[row] - low) / (high - low || 1)));
    const colour = [share * share, 0.1 + 0.8 * share, 0.45 + 0.35 * Math.sin(Math.PI * share) - 0.3 * share];
    colour.forEach((each, channel) => (found.sh[3 * row + channel] = (each - 0.5) / SH_C0));
  }
  return found;
}

const words = new Uint32Array(1);
const floats = new Float32Array(words.buffer);

function number(model: Gaussians, by: Colouring, row: number): number {
  const scales = model.logScales.subarray(3 * row, 3 * row + 3);
  switch (by) {
    case 'opacity': return opacity(model.opacityLogits[row]);
    case 'size': return Math.max(...scales);
    case 'elongation': return Math.max(...scales) - Math.min(...scales);
    case 'rotation': return Math.abs(model.quats[4 * row]) / (Math.hypot(...model.quats.subarray(4 * row, 4 * row + 4)) || 1);
    default:
      floats[0] = coefficients(model.shDegree) > 1 ? model.sh[3 * coefficients(model.shDegree) * row + 3] : scales[0];
      return (words[0] >>> 1) & 255;
  }
}
