import { expect, test } from 'vitest';
import { appendedReader } from '../src/channels/appended/appended_reader.ts';
import { type Payload, type Reader, unpackPayload } from '../src/channels/container.ts';
import { Fountain, NOISY } from '../src/channels/colours/fountain.ts';
import { coloursReader } from '../src/channels/colours/colours_reader.ts';
import { channelsOf, firstOf } from '../src/channels/opening.ts';
import { COLUMNS, emptyGaussians, type Gaussians, opacity, selected, where, withDegree } from '../src/core/gaussians.ts';
import { fittedSimilarity, moved, movedPoint, type Similarity } from '../src/core/similarity.ts';
import { distance, vectorAt } from '../src/core/vectors.ts';
import { mixed, multiplicities, sortingOrder } from '../src/core/words.ts';
import { type Derive, expand, here, roundRobin, sequential } from '../src/keys/keys.ts';
import { digest, hex, jsonVector, modelOf, random, type Revealed } from './vectors.ts';

const OPENED = jsonVector<Revealed[]>('revealed.json');
const NOTE = OPENED.find((each) => each.file === 'colours.spz')!;

const NOTHING = emptyGaussians(0, 0);

/** All Gaussians of several models, of the SH degree of the first one. */
function together(...models: Gaussians[]): Gaussians {
  const found = emptyGaussians(models.reduce((sum, each) => sum + each.count, 0), models[0].shDegree);
  let at = 0;
  for (const each of models.map((model) => withDegree(model, found.shDegree))) {
    for (const column of COLUMNS) found[column].set(each[column], at * (found[column].length / found.count));
    at += each.count;
  }
  return found;
}

/** Rows of a model in another order, of which a share is left. */
function some(model: Gaussians, share: number, seed: number): Gaussians {
  const draw = random(seed);
  const rows = Array.from({ length: model.count }, (_, row) => ({ row, place: draw() }));
  return selected(model, rows.sort((a, b) => a.place - b.place).slice(0, share * model.count).map(({ row }) => row));
}

/** Every key is derived once, however often it is asked for. */
function remembered(derive: Derive): Derive {
  const known = new Map<string, Promise<Uint8Array>>();
  return (key, salt) => {
    const name = `${key} ${salt.join()}`;
    if (!known.has(name)) known.set(name, derive(key, salt));
    return known.get(name)!;
  };
}

/** Something of Argon2id's size that takes no time. */
const quick: Derive = async (key, salt) => expand(salt, `test/${key}`);

test('the hash matches Python', () => {
  const numbers = [0n, 1n, 2n ** 64n - 1n, 0x123456789abcdef0n, 2n ** 32n, 2n ** 63n];
  expect([...new BigUint64Array(mixed(new Uint32Array(new BigUint64Array(numbers).buffer)).buffer)]).toEqual([
    0xe220a8397b1dcdafn, 0x910a2dec89025cc1n, 0xe4d971771b652c20n, 0x161922c645ce50e8n, 0xc42c5a1aa3820138n,
    0x481ec0a212a9f3dbn, // keyss.channels.mixing
  ]);
});

test('words sort stably like BigInt', () => {
  const draw = random(1);
  const numbers = Array.from({ length: 300 }, () => BigInt(Math.floor(draw() * 40)) << BigInt(Math.floor(draw() * 59)));
  const words = new Uint32Array(new BigUint64Array(numbers).buffer);
  const expected = [...numbers.keys()].sort((a, b) => (numbers[a] < numbers[b] ? -1 : numbers[a] > numbers[b] ? 1 : a - b));
  expect([...sortingOrder(words)]).toEqual(expected);
  expect([...multiplicities(words)]).toEqual(numbers.map((each) => numbers.filter((other) => other === each).length));
});

test.each([[112, NOISY, 3, 0.05], [2000, undefined, 1.9, 0.05], [40_000, undefined, 1.8, 0.05]])(
  'a fountain code of %i bits corrects errors',
  (size, degrees, rate, wrong) => {
    const draw = random(size);
    const data = Uint8Array.from({ length: size }, () => Math.floor(2 * draw()));
    const seeds = Uint32Array.from({ length: 2 * Math.ceil(rate * size) }, () => Math.floor(draw() * 2 ** 32));
    const code = new Fountain(size, degrees);
    const hints = Array.from(code.encode(data, seeds), (bit) => (bit === Number(draw() < wrong) ? 1 : -1) * (1 - 2 * wrong));
    expect(digest(code.decode(seeds, hints))).toBe(digest(data));
  },
);

test('a similarity is recovered from points', () => {
  const draw = random(5);
  const turned: Similarity = { scale: 0.3, rotation: [0.5, -0.5, 0.1, 0.7], translation: [3, -2, 1] };
  const points = Array.from({ length: 30 }, draw);
  const there = [...Array(10).keys()].flatMap((at) => [...movedPoint(turned, vectorAt(points, at))]);
  const found = fittedSimilarity(points, there, [...Array(10).keys()])!;
  expect(found.scale).toBeCloseTo(turned.scale, 12);
  found.rotation.forEach((each, index) => expect(each).toBeCloseTo(turned.rotation[index], 12));
  expect(distance(found.translation, turned.translation)).toBeCloseTo(0, 11);
  expect(fittedSimilarity([1, 1, 1, 1, 1, 1], points, [0, 1])).toBeNull();
});

test('appended Gaussians survive pruning of a fifth and any order', async () => {
  const model = await modelOf('appended.ply');
  const [wanted, larger] = [true, false].map((file) => OPENED.find((each) => each.file === 'appended.ply' && file === 'payload' in each)!);
  const derive = remembered(here);
  const found = await appendedReader(some(model, 0.8, 7))!.open(wanted.key, derive);
  expect(digest(found!.data)).toBe(wanted.payload);
  await expect(appendedReader(some(model, 0.5, 8))!.open(larger.key, derive)).rejects.toThrow(/^The key is right/);
  expect(await appendedReader(model)!.open('another key', derive)).toBeNull();
  expect(appendedReader(selected(model, [...Array(120).keys()]))).toBeNull(); // the cover alone
});

test('a secret put into another file is told', async () => {
  const [model, wanted] = [await modelOf('appended.ply'), OPENED.find((each) => each.file === 'appended.ply' && 'payload' in each)!];
  const isVisible = (row: number): boolean => opacity(model.opacityLogits[row]) > 0.5;
  const [cover, appended] = [where(model, isVisible), where(model, (row) => !isVisible(row))];
  const host = some(await modelOf('published.spz'), 1, 3);
  const speck = selected(cover, new Uint8Array(30_000));
  const scattered = { ...speck, logScales: speck.logScales.map((each) => each - 6), means: speck.means.map((each, at) => each + at / 1e4) };
  const shrunken = moved({ scale: 1e-3, rotation: [1, 0, 0, 0], translation: [0, 0, 0] }, together(cover, cover));
  const derive = remembered(here);
  for (const added of [NOTHING, cover, scattered, shrunken]) {
    const found = await appendedReader(together(appended, host, added))!.open(wanted.key, derive);
    expect(digest(found!.data)).toBe(wanted.payload);
    expect(found!.foreign).toBeGreaterThan(100);
  }
  const faint = { ...speck, opacityLogits: speck.opacityLogits.map(() => Math.log(1.5 / 253.5)) };
  expect(digest((await appendedReader(together(model, faint))!.open(wanted.key, derive))!.data)).toBe(wanted.payload);
  for (const kept of [model, together(appended, some(cover, 0.3, 4))]) {
    expect((await appendedReader(kept)!.open(wanted.key, derive))!.foreign).toBeUndefined();
  }
});

test('a secret beside a model that is far larger, or has equal numbers, warns', async () => {
  const [model, wanted] = [await modelOf('appended.ply'), OPENED.find((each) => each.file === 'appended.ply' && 'payload' in each)!];
  const host = await modelOf('published.spz');
  const far: Similarity = { scale: 1e6, rotation: [1, 0, 0, 0], translation: [1e9, 1e9, 1e9] };
  const equal = { ...host, opacityLogits: host.opacityLogits.map(() => 2), logScales: host.logScales.map(() => -4) };
  for (const file of [together(host, moved(far, model)), together(equal, model)]) {
    const found = await appendedReader(file)!.open(wanted.key, remembered(here));
    expect(digest(found!.data)).toBe(wanted.payload);
    expect(found!.foreign).toBeGreaterThan(0.9 * host.count);
  }
});

test('two files of one cover, put into one, are told', async () => {
  const payload = { method: 'file', data: new Uint8Array(0) };
  const reader: Reader = { derivations: 1, open: async () => payload };
  const once = await modelOf('appended.ply');
  const opened = (model: Gaussians): Promise<Payload | null> => firstOf([reader], model).open('key');
  expect(await opened(once)).toEqual(payload);
  expect((await opened(together(once, some(once, 1, 2))))!.foreign).toBe(once.count - where(once, (row) => opacity(once.opacityLogits[row]) < 2 / 255).count);
});

test('a note put into another model is told', async () => {
  const model = await modelOf('colours-moved.splat');
  const key = OPENED.find((each) => each.file === 'colours-moved.splat')!.key;
  const derive = remembered(here);
  expect((await coloursReader(model).open(key, derive))!.foreign).toBeUndefined();
  const few = some(model, 0.2, 6);
  const [specks, host] = [{ ...model, logScales: model.logScales.map((each) => each - 7) }, { ...few, sh: few.sh.map((each) => -each) }];
  expect((await coloursReader(together(specks, host)).open(key, derive))!.foreign).toBeGreaterThan(host.count);
});

test('colours survive scaling, any order and pruning of a fifth', async () => {
  const model = await modelOf(NOTE.file);
  const derive = remembered(here);
  const fewer = some(model, 0.8, 9);
  const larger = { ...fewer, logScales: fewer.logScales.map((each) => each + Math.log(1.37)) };
  for (const changed of [fewer, larger]) {
    const found = await coloursReader(changed).open(NOTE.key, derive);
    expect(digest(found!.data)).toBe(NOTE.payload);
  }
});

test('wrong keys open nothing in colours, nor in models without them', async () => {
  const model = await modelOf(NOTE.file);
  expect(await coloursReader(model).open('another key', quick)).toBeNull();
  for (const count of [0, 1, 20]) {
    expect(await coloursReader(selected(model, [...Array(count).keys()])).open(NOTE.key, quick)).toBeNull();
  }
});

test('channels report their number of derivations', async () => {
  for (const [file, quickly] of Object.entries({ 'appended.ply': 5, 'colours.spz': 1, 'carried.ply': 4 })) {
    for (const thorough of [false, true]) {
      const channel = await channelsOf(await modelOf(file), thorough);
      if (!thorough) expect(channel.derivations).toBe(quickly);
      let asked = 0;
      await channel.open('any key', async (key, salt) => {
        asked++;
        return quick(key, salt);
      });
      expect(asked).toBe(channel.derivations);
    }
  }
});

test('the first channel that opens wins, and all are searched', async () => {
  const asked: string[] = [];
  const reader = (name: string, found: Payload | null | Error): Reader => ({
    derivations: 1,
    open: async () => {
      asked.push(name);
      if (found instanceof Error) throw found;
      return found;
    },
  });
  const payload = (method: string): Payload => ({ method, data: new Uint8Array(0) });
  const [none, first, second] = [reader('none', null), reader('first', payload('first')), reader('second', payload('second'))];
  expect((await firstOf([none, first, second], NOTHING).open('key'))?.method).toBe('first');
  expect(asked).toEqual(['none', 'first', 'second']);
  await expect(firstOf([reader('damaged', new Error('damaged.')), first], NOTHING).open('key')).rejects.toThrow('damaged.');
  expect(await firstOf([none], NOTHING).open('key')).toBeNull();
});

test('derivations run sequentially, or round robin over several', async () => {
  let [running, most] = [0, 0];
  const slow: Derive = async (key, salt) => {
    most = Math.max(most, ++running);
    await new Promise((resolve) => setTimeout(resolve, 5));
    running--;
    if (key === 'bad') throw new Error('no memory');
    return salt;
  };
  const salts = Array.from({ length: 6 }, (_, index) => Uint8Array.of(index));
  const single = sequential(slow);
  const bad = expect(single('bad', salts[0])).rejects.toThrow();
  expect(await Promise.all(salts.map((salt) => single('key', salt)))).toEqual(salts);
  await bad;
  expect(most).toBe(1);
  const several = roundRobin([sequential(slow), sequential(slow)]);
  expect(await Promise.all(salts.map((salt) => several('key', salt)))).toEqual(salts);
  expect(most).toBe(2);
});

test('payload packing', () => {
  expect(unpackPayload(hex('66696c6500616263'))).toEqual({ method: 'file', data: hex('616263') });
  for (const damaged of ['', '00', '0066', '66696c65', '80696c6500', '30313233343536373839303132333435' + '00']) {
    expect(() => unpackPayload(hex(damaged))).toThrow(/damaged: download or copy it again\.$/);
  }
});
