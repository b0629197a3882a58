/** A secret that is a model, as `keyss reveal` gives it. */
import { damaged } from '../core/errors.ts';
import type { Content } from '../channels/content.ts';
import { viewOf } from '../core/bytes.ts';
import { compensated, type Gaussians } from '../core/gaussians.ts';
import { decodeKeyss } from '../keyss/secret.ts';
import { Codec } from './codec.ts';
import { decodeWhole } from './whole.ts';

const WHOLE = 'carry'; // the method of models that are hidden whole, whoever trained them
const KEYSS = 'keyss';

export interface Secret {
  readonly gaussians: Gaussians;
  readonly hidden: number; // how many there were
}

/** The Gaussians that are left; null for what is no model. `stego`: where it was. Raises InputError for damage. */
export function secretOf(content: Content, stego: Gaussians): Secret | null {
  if (content.service === 'payload') {
    if (content.method === KEYSS) return decodeKeyss(content.data, stego);
    if (content.method !== WHOLE) return null;
    const gaussians = decodeWhole(content.data, stego.count);
    return { gaussians, hidden: gaussians.count };
  }
  if (content.header.length < 4) throw damaged();
  const hidden = viewOf(content.header).getUint32(0, true);
  const codec = Codec.unpack(content.header.subarray(4));
  if (content.records[0].length !== codec.recordBytes) throw damaged();
  return { gaussians: compensated(codec.decode(content.records), hidden), hidden };
}
