/** Deriving many keys: one after the other, or several side by side. */
import { type Derive, master } from './keys.ts';

/** `derive` for one key after the other, however many are asked for at once: each takes 64 MiB. */
export function oneByOne(derive: Derive): Derive {
  let last: Promise<unknown> = Promise.resolve();
  return (key, salt) => {
    const own = last.then(() => derive(key, salt));
    last = own.catch(() => undefined);
    return own;
  };
}

/** Several that derive keys, each in turn. */
export function inTurn(derives: readonly Derive[]): Derive {
  let next = 0;
  return (key, salt) => derives[next++ % derives.length](key, salt);
}

/** In this thread. */
export const here: Derive = oneByOne(master);

/** By a worker that answers in order: with 32 bytes, or null. */
export function derivedBy(worker: Worker): Derive {
  const waiting: ((found: Uint8Array | null) => void)[] = [];
  worker.onmessage = ({ data }: MessageEvent<Uint8Array | null>) => waiting.shift()?.(data);
  return (key, salt) =>
    new Promise((resolve, reject) => {
      waiting.push((found) => (found === null ? reject(new Error('no memory')) : resolve(found)));
      worker.postMessage({ key, salt });
    });
}

/** A worker from a blob: a page that is one file and opens from disk can have no other. */
export function started(source: string): Worker {
  return new Worker(URL.createObjectURL(new Blob([source], { type: 'text/javascript' })));
}
