import { expect, test } from 'vitest';
import { selected } from '../src/core/gaussians.ts';
import { inverse, moved } from '../src/core/similarity.ts';
import { decodeKeyss } from '../src/keyss/secret.ts';
import { hex, jsonVector, modelOf } from './vectors.ts';

interface Revealed {
  file: string;
  payload: string;
  count: number;
  rows: Record<string, number[]>; // every 49th
}

const KEYSS = jsonVector<Revealed[]>('keyss.json');
const LATENT = KEYSS.filter(({ file }) => file.startsWith('latent'));
const OTHERS = KEYSS.filter(({ file }) => !file.startsWith('latent'));
const STRIDE = 49;

test.each(LATENT)('decoding $file matches Python to 1e-5, $count Gaussians', async (expected) => {
  const gaussians = decodeKeyss(hex(expected.payload), await modelOf(expected.file))!;
  expect(gaussians.count).toBe(expected.count);
  const { means, quats, logScales, opacityLogits, sh } = gaussians;
  const columns = { means, quats, log_scales: logScales, opacity_logits: opacityLogits, sh };
  for (const [name, values] of Object.entries(columns)) {
    const width = values.length / gaussians.count;
    const found = [...values].filter((_, at) => Math.floor(at / width) % STRIDE === 0);
    expect(found.length).toBe(expected.rows[name].length);
    const worst = expected.rows[name].map((each, at) => Math.abs(found[at] - each) / Math.max(1, Math.abs(each)));
    expect([name, Math.max(...worst) < 1e-5]).toEqual([name, true]);
  }
});

test('lost and reordered rows leave the others unchanged', async () => {
  const { file, payload } = LATENT[0];
  const model = await modelOf(file);
  const all = decodeKeyss(hex(payload), model)!;
  const rows = [...Array(model.count).keys()].filter((row) => row % 8).reverse();
  const some = decodeKeyss(hex(payload), selected(model, rows))!;
  const names = [...some.means].map(String);
  expect(some.count).toBeGreaterThan(all.count / 2);
  expect([...all.means].map(String)).toEqual(expect.arrayContaining(names));
});

test.each(LATENT.slice(0, 2))('rounded models and damage are refused', async ({ file, payload }) => {
  const model = await modelOf(file);
  const rounded = { ...model, means: model.means.map((each) => Math.round(each * 1000) / 1000) };
  expect(() => decodeKeyss(hex(payload), rounded)).toThrow(/^The model was moved or rounded/);
  for (let at = 0; at < payload.length / 2; at += 29) {
    for (const bytes of [hex(payload).slice(0, at), hex(payload)]) {
      if (bytes.length > at) bytes[at] ^= 1 << at % 8;
      try {
        expect(decodeKeyss(bytes, model)!.means.every(Number.isFinite)).toBe(true);
      } catch (error) {
        expect((error as Error).message).toMatch(/^(This file|What this key opens|The model was).*\.$/);
      }
    }
  }
});

test.each(LATENT.slice(0, 2))('out-of-range headers are refused: $file', async ({ file, payload }) => {
  const [model, bytes] = [await modelOf(file), Buffer.from(payload, 'hex')];
  const end = 8 + Number(bytes.readBigUInt64LE());
  const header = bytes.toString('latin1', 8, end).replaceAll('\\"', "'");
  const decode = (from: RegExp, to: string): unknown => {
    const changed = header.replace(from, to);
    expect([from, changed]).not.toEqual([from, header]);
    const size = Buffer.alloc(8);
    const text = Buffer.from(changed.replaceAll("'", '\\"'), 'latin1');
    size.writeBigUInt64LE(BigInt(text.length));
    return decodeKeyss(Uint8Array.from(Buffer.concat([size, text, bytes.subarray(end)])), model);
  };
  const changes: [RegExp, string][] = [
    [/keyss-secret/, 'keyss-secrets'], [/'mask':/, "'mask':1,'more':"],
    [/'key_size':64/, "'key_size':65"], [/'sh_degree':\d/, "'sh_degree':4"],
    [/'secret':\d/, "'secret':9"], [/'secrets':\d/, "'secrets':0"], [/'count':\d/, "'count':-1"], [/'visibility':/, "'visibility':-"], [/'visibility':/, "'visibility':1e999,'more':"],
    [/'scale':\d/, "'scale':-1"], [/'rotation':../, "'rotation':[[2"], [/"key"/, '"kex"'], [/decoder/, 'recoded'],
    [/"anchors".*?]/, '"anchors":{"dtype":"F32","shape":[0,3]'], [/"shape":\[64\]/, '"shape":[-4]'], [/"F16"/, '"I16"'],
    [/("decoder.*?offsets":\[)/, '$1-1'],
  ];
  for (const [from, to] of changes) expect(() => decode(from, to), String(from)).toThrow('This file is damaged.');
  expect(() => decode(/'version':10/, "'version':11")).toThrow(/another version/);
});

test.each(OTHERS)('other designs are left to Python: $count Gaussians', async ({ file, payload }) => {
  expect(decodeKeyss(hex(payload), await modelOf(file))).toBeNull();
});

test('a similarity and its inverse cancel', async () => {
  const model = await modelOf('carried.ply');
  const turn = [0, -0.6, 0.8, 1, 0, 0, 0, 0.8, 0.6];
  const similarity = { scale: 2.5, rotation: turn, translation: [3, -4, 0.1] };
  const back = moved(inverse(similarity), moved(similarity, model));
  for (const column of ['means', 'logScales', 'sh'] as const) {
    back[column].forEach((each, at) => {
      if (Math.abs(each - model[column][at]) > 1e-5) throw new Error(`${column} ${at}`);
    });
  }
});
