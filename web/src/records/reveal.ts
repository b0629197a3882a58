/** From the content of a channel to what `keyss reveal` gives: a model or a file. */
import type { Content } from '../channels/content.ts';
import { viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { compensated, type Gaussians } from '../core/gaussians.ts';
import { decodeKeyss } from '../keyss/secret.ts';
import { decodeRecords } from './codec.ts';
import { decodeWhole } from './whole.ts';

const [WHOLE, KEYSS, FILE] = ['carry', 'keyss', 'file']; // methods

export interface HiddenFile {
  readonly name: string; // from the sender: to be shown, never to be used as a path
  readonly bytes: Uint8Array;
}

/** Null if the content is not a file. */
export function fileOf(content: Content): HiddenFile | null {
  if (content.service !== 'payload' || content.method !== FILE) return null;
  const size = content.data[0];
  return { name: new TextDecoder().decode(content.data.subarray(1, 1 + size)), bytes: content.data.slice(1 + size) };
}

/** The model, found in `stego`; null if the content is none, or none that is opened here. Raises InputError for damage. */
export function secretOf(content: Content, stego: Gaussians): Gaussians | null {
  if (content.service === 'payload') {
    if (content.method === KEYSS) return decodeKeyss(content.data, stego);
    return content.method === WHOLE ? decodeWhole(content.data, stego.count) : null;
  }
  if (content.header.length < 4) throw damaged();
  const hidden = viewOf(content.header).getUint32(0, true);
  return compensated(decodeRecords(content.header.subarray(4), content.records), hidden);
}
