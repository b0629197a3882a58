/** Argon2id in workers of its own, beside the one that looks through the channels. */
import { answering } from './keys/pool.ts';

self.onmessage = ({ ports: [port] }: MessageEvent) => answering(port);
