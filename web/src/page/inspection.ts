/** Inspection of the public model without a key: filters by opacity, and colours by attribute. */
import { quantile } from '../core/bytes.ts';
import { type Gaussians, opacity, where, withDegree } from '../core/gaussians.ts';
import { SH_C0 } from '../files/coded.ts';
import { count, page } from './panel.ts';

const OPAQUE_LOGIT = 3;
const FAINT = 0.1; // default opacity threshold for `faint`
const AFTER = 100; // ms after the last change of a slider
const MIN_DRAWN = 1 / 255; // opacity

/** Calls `changed` after the settings change. */
export function listenToInspection(changed: () => void): void {
  let timer = 0;
  page.faint.addEventListener('input', () => {
    if (page.faint.checked && Number(page.threshold.value) === 0) page.threshold.value = String(FAINT);
  });
  for (const input of [page.threshold, page.faint, page.opaque, page.colouring]) {
    input.addEventListener('input', () => {
      page.shown.value = Number(page.threshold.value).toFixed(3);
      clearTimeout(timer);
      timer = window.setTimeout(changed, AFTER);
    });
  }
}

/** The Gaussians to show of a model; displays their number. */
export function inspected(model: Gaussians): Gaussians {
  const [threshold, below] = [Number(page.threshold.value), page.faint.checked];
  const opacities = model.opacityLogits.map(opacity);
  let found = where(model, (row) => opacities[row] < threshold === below);
  if (page.colouring.value === 'constant colour') found = withDegree(found, 0);
  else if (page.colouring.value !== 'as it is') found = coloured(found, page.colouring.value);
  if (page.opaque.checked) found = { ...found, opacityLogits: found.opacityLogits.map(() => OPAQUE_LOGIT) };
  const faint = opacities.filter((each) => each < MIN_DRAWN).length;
  page.count.textContent =
    `${count(found.count)} of ${count(model.count)} Gaussians shown; ${count(faint)} are too faint to be drawn`;
  return found;
}

/** The Gaussians coloured from blue over green to yellow by an attribute. */
function coloured(model: Gaussians, by: string): Gaussians {
  const values = Float64Array.from({ length: model.count }, (_, row) => attribute(model, by, row));
  const [low, high] = [0.02, 0.98].map((share) => quantile(values, share));
  const found = { ...model, shDegree: 0, sh: new Float32Array(3 * model.count) };
  for (let row = 0; row < model.count; row++) {
    const share = Math.min(1, Math.max(0, (values[row] - low) / (high - low || 1)));
    const colour = [share * share, 0.1 + 0.8 * share, 0.45 + 0.35 * Math.sin(Math.PI * share) - 0.3 * share];
    colour.forEach((each, channel) => (found.sh[3 * row + channel] = (each - 0.5) / SH_C0));
  }
  return found;
}

const words = new Uint32Array(1);
const floats = new Float32Array(words.buffer);

function attribute(model: Gaussians, by: string, row: number): number {
  const scales = model.logScales.subarray(3 * row, 3 * row + 3);
  switch (by) {
    case 'opacity': return opacity(model.opacityLogits[row]);
    case 'size': return Math.max(...scales);
    case 'elongation': return Math.max(...scales) - Math.min(...scales);
    case 'rotation': return Math.abs(model.quats[4 * row]) / (Math.hypot(...model.quats.subarray(4 * row, 4 * row + 4)) || 1);
    default:
      floats[0] = model.shDegree > 0 ? model.sh[(row * model.sh.length) / model.count + 3] : scales[0];
      return (words[0] >>> 1) & 255;
  }
}
