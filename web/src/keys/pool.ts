/** Scheduling of key derivations: sequential, or in several workers. */
import { type Derive, master } from './keys.ts';

/** `derive` with at most one derivation at a time, since each takes 64 MiB. */
export function sequential(derive: Derive): Derive {
  let last: Promise<unknown> = Promise.resolve();
  return (key, salt) => {
    const own = last.then(() => derive(key, salt));
    last = own.catch(() => undefined);
    return own;
  };
}

/** Distributes derivations over several. */
export function roundRobin(derives: readonly Derive[]): Derive {
  let next = 0;
  return (key, salt) => derives[next++ % derives.length](key, salt);
}

/** In this thread. */
export const here: Derive = sequential(master);

/** By a worker that answers in order, with 32 bytes or null. */
export function deriveInWorker(worker: Worker): Derive {
  const waiting: ((found: Uint8Array | null) => void)[] = [];
  worker.onmessage = ({ data }: MessageEvent<Uint8Array | null>) => waiting.shift()?.(data);
  return (key, salt) =>
    new Promise((resolve, reject) => {
      waiting.push((found) => (found === null ? reject(new Error('no memory')) : resolve(found)));
      worker.postMessage({ key, salt });
    });
}

/** A worker from a blob, the only kind in a single-file page that opens from disk. */
export function startWorker(source: string): Worker {
  return new Worker(URL.createObjectURL(new Blob([source], { type: 'text/javascript' })));
}
