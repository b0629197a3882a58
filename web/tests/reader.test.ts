/** The package keyss-reader as `make reader` builds it, under Node.js. */
import { execFileSync } from 'node:child_process';
import { mkdtempSync, readFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { gzipSync } from 'node:zlib';
import { beforeAll, expect, test } from 'vitest';
import type * as Reader from '../reader/index.d.ts';
import { openPly, readPly } from '../src/files/ply.ts';
import { columns, decodeWebP, digest, jsonVector, type Revealed, vector } from './vectors.ts';

// One of each channel and of each kind of secret.
const FILES = ['carried.ply', 'coded.sog', 'coded.compressed.ply', 'appended-moved.spz', 'colours-moved.splat'];
const REVEALED = jsonVector<Revealed[]>('revealed.json').filter(({ file }) => FILES.includes(file));
const WEB = new URL('..', import.meta.url).pathname;
const out = mkdtempSync(join(tmpdir(), 'keyss-reader-'));
let reveal: Reader.Reveal;

beforeAll(async () => {
  execFileSync('node', ['build.mjs', '--reader', out], { cwd: WEB });
  ({ reveal } = (await import(/* @vite-ignore */ join(out, 'index.js'))) as typeof Reader);
});

test.each(REVEALED)('revealing $file with $key matches Python', async ({ file, key, sha256, count, payload }) => {
  const shares: number[] = [];
  const found = await reveal(vector(file), key, { name: file, decodeWebP, onProgress: (share) => shares.push(share) });
  expect(shares).toEqual(shares.slice().sort((a, b) => a - b));
  expect(shares.at(-1)).toBe(1);
  if (found?.kind === 'file') {
    const name = new TextEncoder().encode(found.name);
    expect(digest(Uint8Array.of(name.length, ...name, ...found.bytes))).toBe(payload);
  } else {
    expect(found?.gaussians).toBe(count);
    expect(columns(readPly(openPly(found!.ply)))).toEqual(sha256);
  }
});

test('wrong keys open nothing', async () => {
  expect(await reveal(vector('carried.ply'), 'another key')).toBeNull();
});

test('searches can be aborted before and while they run', async () => {
  const bytes = vector('carried.ply');
  await expect(reveal(bytes, 'any', { signal: AbortSignal.abort(new Error('enough')) })).rejects.toThrow('enough');
  const stop = new AbortController();
  const onProgress = (): void => stop.abort(new Error('enough'));
  await expect(reveal(bytes, 'any', { signal: stop.signal, onProgress })).rejects.toThrow('enough');
});

test('what cannot be opened raises InputError', async () => {
  for (const [bytes, key] of [[new Uint8Array(9), 'key'], [vector('carried.ply'), ' ']] as const) {
    await expect(reveal(bytes, key)).rejects.toMatchObject({ name: 'InputError' });
  }
  await expect(reveal(vector('coded.sog'), 'key')).rejects.toThrow(/only browsers/);
  await expect(reveal(vector('keyss.ply'), REVEALED[0].key)).rejects.toThrow(/only keyss reveal/);
});

test('the package is complete and at most 70 kB', () => {
  const [packed] = JSON.parse(execFileSync('npm', ['pack', '--dry-run', '--json'], { cwd: out, encoding: 'utf8' }));
  const names = (packed.files as { path: string }[]).map(({ path }) => path).sort();
  const examples = ['opening.js', 'playcanvas.html', 'spark.html', 'worker.js'].map((name) => `examples/${name}`);
  expect(names).toEqual(['LICENSE', 'README.md', ...examples, 'index.d.ts', 'index.js', 'licences.txt', 'package.json']);
  expect(packed.size).toBeLessThan(70_000);
  expect(gzipSync(readFileSync(join(out, 'index.js'))).length).toBeLessThan(60_000);
});
