/** A secret that is a model, as `keyss reveal` gives it. */
import type { Content } from '../channels/content.ts';
import { viewOf } from '../core/bytes.ts';
import { type Gaussians, opacity } from '../core/gaussians.ts';
import { damaged } from '../keys/encryption.ts';
import { Codec } from './codec.ts';
import { decodeWhole } from './whole.ts';

const WHOLE = 'carry'; // the method of models that are hidden whole, whoever trained them
const GROWTH = 0.25;
const MOST_LOST = 0.9;
const LEAST_LOST = 0.01;

export interface Secret {
  readonly gaussians: Gaussians;
  readonly hidden: number; // how many there were
}

/** The Gaussians that are left; null for what is no model. Raises InputError for damage. */
export function secretOf(content: Content): Secret | null {
  if (content.service === 'payload') {
    if (content.method !== WHOLE) return null;
    const gaussians = decodeWhole(content.data);
    return { gaussians, hidden: gaussians.count };
  }
  if (content.header.length < 4) throw damaged();
  const hidden = viewOf(content.header).getUint32(0, true);
  const codec = Codec.unpack(content.header.subarray(4));
  if (content.records[0].length !== codec.recordBytes) throw damaged();
  return { gaussians: compensated(codec.decode(content.records), hidden), hidden };
}

/** The Gaussians that remain of `count`, denser and larger, so that they cover as much; see docs/format.md. */
export function compensated(gaussians: Gaussians, count: number): Gaussians {
  const share = Math.max(gaussians.count / Math.max(count, 1), 1 - MOST_LOST);
  if (share >= 1 - LEAST_LOST) return gaussians;
  const opacityLogits = gaussians.opacityLogits.map((logit) => {
    const left = Math.min(Math.max(1 - Math.fround(opacity(logit)), 1e-7), 1 - 1e-7);
    const opaque = 1 - Math.max(left ** (1 / share), 1e-7);
    return Math.log(opaque / (1 - opaque));
  });
  const grown = Math.fround(GROWTH * Math.log(1 / share));
  return { ...gaussians, opacityLogits, logScales: gaussians.logScales.map((each) => each + grown) };
}
