/** From a payload to what `keyss reveal` gives: a model or a file. */
import type { Payload } from './channels/container.ts';
import { decodeModel } from './codec/model_bytes.ts';
import type { Gaussians } from './core/gaussians.ts';

const [CARRY, FILE] = ['carry', 'file']; // methods

export interface HiddenFile {
  readonly name: string; // from the sender: to be shown, never to be used as a path
  readonly bytes: Uint8Array;
}

/** Null if the payload is not a file. */
export function fileOf({ method, data }: Payload): HiddenFile | null {
  if (method !== FILE) return null;
  const size = data[0];
  return { name: new TextDecoder().decode(data.subarray(1, 1 + size)), bytes: data.slice(1 + size) };
}

/** The model, found in `stego`; null if the payload is none, or none that is opened here. Raises InputError for damage. */
export function secretOf({ method, data }: Payload, stego: Gaussians): Gaussians | null {
  return method === CARRY ? decodeModel(data, stego.count) : null;
}
