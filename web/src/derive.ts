/** Argon2id in a worker of its own, beside the one that looks through the cells. */
import { master } from './keys/derivation.ts';

self.onmessage = ({ ports: [port] }: MessageEvent) => {
  port.onmessage = async ({ data }: MessageEvent<{ key: string; salt: Uint8Array }>) => {
    try {
      port.postMessage(await master(data.key, data.salt));
    } catch {
      port.postMessage(null);
    }
  };
};
