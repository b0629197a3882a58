/** What makes up for lost Gaussians; `keyss.core.pruning_compensation` on the other side. */
import { type Gaussians, opacity } from '../core/gaussians.ts';

const GROWTH = 0.25;
const MAX_LOST = 0.9;
const MIN_LOST = 0.01;

/** The Gaussians that remain of `count`, denser and larger, so that they cover as much; see docs/format.md. */
export function compensated(gaussians: Gaussians, count: number): Gaussians {
  const share = Math.max(gaussians.count / Math.max(count, 1), 1 - MAX_LOST);
  if (share >= 1 - MIN_LOST) return gaussians;
  const opacityLogits = gaussians.opacityLogits.map((logit) => {
    const left = Math.min(Math.max(1 - Math.fround(opacity(logit)), 1e-7), 1 - 1e-7);
    const opaque = 1 - Math.max(left ** (1 / share), 1e-7);
    return Math.log(opaque / (1 - opaque));
  });
  const grown = Math.fround(GROWTH * Math.log(1 / share));
  return { ...gaussians, opacityLogits, logScales: gaussians.logScales.map((each) => each + grown) };
}
