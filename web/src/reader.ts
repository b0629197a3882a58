/** Entry point of the package `keyss-reader`: reveals without the page. Its types are in web/reader. */
import type { Reveal } from '../reader/index.d.ts';
import { channelsOf } from './channels/opening.ts';
import { InputError } from './core/errors.ts';
import { readModel } from './files/models.ts';
import { writePly } from './files/ply.ts';
import { fileOf, secretOf } from './hidden.ts';
import { type Derive, keyBytes, master, sequential } from './keys/keys.ts';

const QUICK = 0.2; // share of the progress: colours, searched last, take four times as long as all else

export const reveal: Reveal = async (bytes, key, { name, decodeWebP, signal, onProgress } = {}) => {
  keyBytes(key); // validates
  signal?.throwIfAborted();
  const stego = await readModel(bytes, name, decodeWebP);
  for (const [thorough, from, to] of [[false, 0, QUICK], [true, QUICK, 1]] as const) {
    const reader = await channelsOf(stego, thorough);
    let done = 0;
    const derive: Derive = sequential(async (...asked) => {
      await new Promise((resolve) => setTimeout(resolve, 0)); // lets other events run, such as an abort
      signal?.throwIfAborted();
      const found = await master(...asked);
      onProgress?.(from + ((to - from) * ++done) / reader.derivations);
      return found;
    });
    const payload = await reader.open(key, derive);
    signal?.throwIfAborted();
    if (payload === null) continue;
    onProgress?.(1);
    const [file, { foreign }] = [fileOf(payload), payload];
    if (file) return { kind: 'file', ...file, foreign };
    const secret = secretOf(payload, stego);
    if (secret === null) throw new InputError('This key opens a model that only keyss reveal decodes.');
    return { kind: 'model', ply: writePly(secret), gaussians: secret.count, foreign };
  }
  onProgress?.(1);
  return null;
};
