/** The page: a published model, a field for a key, and what the key opens. */
import { type Gaussians, opacity } from '../core/gaussians.ts';
import { writePly } from '../files/ply.ts';
import { COLOURINGS, type Look, lookedAt } from './attacker.ts';
import { Controls } from './controls.ts';
import { Opener } from './opener.ts';
import {
  add, difference, firstPose, middleAndRadius, type Pose, poseOfHash, poseToHash, UPS, upOf,
} from './pose.ts';
import { Viewer } from './viewer.ts';

const ADDRESS_AFTER = 400; // milliseconds after the last movement
const MOST_BYTES = 2 ** 31;

function element<T extends HTMLElement>(id: string): T {
  return document.getElementById(id) as T;
}

const page = {
  main: element('main'),
  canvas: element<HTMLCanvasElement>('picture'),
  file: element<HTMLInputElement>('file'),
  form: element<HTMLFormElement>('key-form'),
  key: element<HTMLInputElement>('key'),
  open: element<HTMLButtonElement>('open'),
  status: element('status'),
  progress: element<HTMLProgressElement>('progress'),
  problem: element('problem'),
  facts: element('facts'),
  up: element<HTMLSelectElement>('up'),
  fly: element<HTMLButtonElement>('fly'),
  home: element<HTMLButtonElement>('home'),
  snapshot: element<HTMLButtonElement>('snapshot'),
  download: element<HTMLButtonElement>('download'),
  wipe: element<HTMLInputElement>('wipe'),
  revealed: element('revealed'),
  threshold: element<HTMLInputElement>('threshold'),
  thresholdText: element<HTMLOutputElement>('threshold-text'),
  faint: element<HTMLInputElement>('faint'),
  opaque: element<HTMLInputElement>('opaque'),
  colouring: element<HTMLSelectElement>('colouring'),
  count: element('count'),
};

class Page {
  private name = 'model';
  private published: Gaussians | null = null;
  private secret: Gaussians | null = null;
  private readonly opener = new Opener((share) => (page.progress.value = share));
  private readonly controls: Controls;
  private pose: Pose = { eye: [0, 0, -1], target: [0, 0, 0], up: upOf(page.main.dataset.up) };
  private addressTimer = 0;
  private lookTimer = 0;
  private loads = 0;
  private longest = 0; // milliseconds that a key took so far

  constructor(private readonly viewer: Viewer) {
    this.controls = new Controls(page.canvas, this.pose, (pose) => this.moved(pose), () => this.firstPose());
    this.listen();
  }

  private listen(): void {
    page.file.addEventListener('change', () => page.file.files?.[0] && void this.openFile(page.file.files[0]));
    document.addEventListener('dragover', (event) => event.preventDefault());
    document.addEventListener('drop', (event) => {
      event.preventDefault();
      const file = event.dataTransfer?.files[0];
      if (file) void this.openFile(file);
    });
    page.form.addEventListener('submit', (event) => {
      event.preventDefault();
      void this.unlock();
    });
    page.fly.addEventListener('click', () => {
      this.controls.flying = !this.controls.flying;
      page.fly.setAttribute('aria-pressed', String(this.controls.flying));
    });
    page.up.addEventListener('input', () => {
      this.pose = { ...this.pose, up: upOf(page.up.value) };
      this.controls.setPose(this.firstPose());
    });
    page.home.addEventListener('click', () => this.controls.setPose(this.firstPose()));
    page.snapshot.addEventListener('click', () => void this.viewer.snapshot().then((png) => save('view.png', png)));
    page.download.addEventListener('click', () => {
      if (this.secret) save('secret.ply', new Blob([writePly(this.secret) as BlobPart]));
    });
    page.wipe.addEventListener('input', () => this.viewer.setSplit(Number(page.wipe.value) / 100));
    for (const input of [page.threshold, page.faint, page.opaque, page.colouring]) {
      input.addEventListener('input', () => this.look());
    }
    window.addEventListener('hashchange', ({ newURL }) => {
      const pose = poseOfHash(new URL(newURL).hash); // that of now may be one that was written meanwhile
      if (pose) this.controls.setPose(pose);
    });
  }

  /** A model of the page itself, beside it, or in the address. */
  async start(): Promise<void> {
    const inside = document.getElementById('model');
    const beside = document.querySelector<HTMLMetaElement>('meta[name="keyss-model"]')?.content;
    const asked = new URLSearchParams(location.search).get('file');
    if (inside?.textContent) {
      const text = inside.textContent;
      inside.remove(); // the text is not needed twice
      await this.load(bytesOfBase64(text), inside.dataset.name ?? 'model');
    } else if (asked ?? beside) await this.fetched((asked ?? beside)!);
    else this.say('Open a file, or drop one here.');
  }

  private async fetched(address: string): Promise<void> {
    const url = new URL(address, location.href);
    this.say('Loading …');
    try {
      const response = await fetch(url, { credentials: 'omit' });
      if (!response.ok) throw new Error(String(response.status));
      const bytes = new Uint8Array(await response.arrayBuffer());
      await this.load(bytes, decodeURIComponent(url.pathname.split('/').pop() ?? 'model'));
    } catch {
      this.fail('The file in the address could not be loaded.');
    }
  }

  private async openFile(file: File): Promise<void> {
    if (file.size > MOST_BYTES) return this.fail('This file is larger than 2 GiB.');
    return this.load(new Uint8Array(await file.arrayBuffer()), file.name);
  }

  private async load(bytes: Uint8Array, name: string): Promise<void> {
    const own = ++this.loads;
    this.say('Reading …');
    page.problem.textContent = '';
    const { model, error } = await this.opener.load(bytes, name);
    if (own !== this.loads) return;
    if (model === undefined) return this.fail(error ?? 'This file cannot be read.');
    [this.name, this.published, this.secret] = [name, model, null];
    page.revealed.hidden = true;
    this.longest = 0;
    page.open.disabled = page.key.disabled = false;
    page.facts.textContent = `${this.name}: ${model.count.toLocaleString('en')} Gaussians, SH degree ${model.shDegree}`;
    this.viewer.show(null, 'right');
    this.showPublished();
    this.controls.setPose(poseOfHash(location.hash) ?? this.firstPose());
    await this.picture();
    this.say('');
  }

  /**
   * A key that opens nothing changes nothing, and nothing is said about it. It takes as long as one that opens a scene:
   * the worker makes the same passes, what is there is drawn anew, and no attempt ends sooner than those before it.
   */
  private async unlock(): Promise<void> {
    const key = page.key.value;
    if (!key || this.published === null || page.open.disabled) return;
    const [own, start] = [this.loads, performance.now()];
    page.open.disabled = true;
    page.main.setAttribute('aria-busy', 'true');
    this.say('Trying the key …');
    page.progress.value = 0;
    page.progress.hidden = false;
    const { model, file } = await this.opener.unlock(key);
    page.key.value = '';
    if (own === this.loads) {
      if (model) this.reveal(model);
      else if (this.secret) this.viewer.show(this.secret, 'right');
      else this.showPublished();
      await this.picture();
      const left = this.longest - (performance.now() - start);
      if (left > 0) await new Promise((resolve) => setTimeout(resolve, left));
      this.longest = performance.now() - start;
    }
    if (file) save(file.name.replace(/[^\p{L}\p{N} ._-]/gu, '_') || 'file', new Blob([file.data as BlobPart]));
    page.open.disabled = false;
    page.main.setAttribute('aria-busy', 'false');
    page.progress.hidden = true;
    this.say('');
  }

  private reveal(model: Gaussians): void {
    this.secret = model;
    this.viewer.show(model, 'right');
    this.viewer.setSplit(0);
    page.wipe.value = '0';
    page.revealed.hidden = false;
    this.controls.setPose(this.firstPose());
    this.writeAddress();
  }

  private firstPose(): Pose {
    const model = this.secret ?? this.published;
    return model ? firstPose(model, this.pose.up) : this.pose;
  }

  private moved(pose: Pose): void {
    this.pose = pose;
    page.up.value = pose.up;
    if (this.secret && this.published) {
      this.viewer.setPose(pose, 'right');
      this.viewer.setPose(this.alike(pose, this.secret, this.published));
    } else this.viewer.setPose(pose);
    clearTimeout(this.addressTimer);
    this.addressTimer = window.setTimeout(() => this.writeAddress(), ADDRESS_AFTER);
  }

  private writeAddress(): void {
    clearTimeout(this.addressTimer);
    const hash = poseToHash(this.pose);
    if (this.published && location.hash !== hash) history.replaceState(null, '', hash);
  }

  /** The pose that shows the second model as `pose` shows the first, which has coordinates of its own. */
  private alike(pose: Pose, from: Gaussians, to: Gaussians): Pose {
    const [a, b] = [framing(from), framing(to)];
    const scale = b.radius / a.radius;
    const place = (point: Pose['eye']): Pose['eye'] => add(b.middle, difference(point, a.middle), scale);
    return { eye: place(pose.eye), target: place(pose.target), up: pose.up };
  }

  private look(): void {
    clearTimeout(this.lookTimer);
    page.thresholdText.value = Number(page.threshold.value).toFixed(3);
    this.lookTimer = window.setTimeout(() => {
      this.showPublished();
      if (this.secret) this.viewer.setSplit(Number((page.wipe.value = '100')) / 100); // it is looked at
    }, 100);
  }

  private showPublished(): void {
    if (this.published === null) return;
    const look: Look = {
      threshold: Number(page.threshold.value),
      faintOnly: page.faint.checked,
      opaque: page.opaque.checked,
      colouring: page.colouring.value as Look['colouring'],
    };
    const model = lookedAt(this.published, look);
    const faint = this.published.opacityLogits.filter((logit) => opacity(logit) < 1 / 255).length;
    page.count.textContent =
      `${model.count.toLocaleString('en')} of ${this.published.count.toLocaleString('en')} Gaussians shown; ` +
      `${faint.toLocaleString('en')} are too faint to be drawn`;
    this.viewer.show(model.count ? model : null);
  }

  private async picture(): Promise<void> {
    delete page.main.dataset.picture;
    await this.viewer.settled();
    page.main.dataset.picture = 'settled';
  }

  private say(text: string): void {
    page.status.textContent = text;
  }

  private fail(text: string): void {
    this.say('');
    page.problem.textContent = text;
  }
}

const framings = new WeakMap<Gaussians, ReturnType<typeof middleAndRadius>>();

function framing(model: Gaussians): ReturnType<typeof middleAndRadius> {
  const known = framings.get(model) ?? middleAndRadius(model);
  framings.set(model, known);
  return known;
}

function bytesOfBase64(text: string): Uint8Array {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let at = 0; at < binary.length; at++) bytes[at] = binary.charCodeAt(at);
  return bytes;
}

function save(name: string, data: Blob): void {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(data);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

async function main(): Promise<void> {
  for (const colouring of COLOURINGS) page.colouring.add(new Option(colouring));
  for (const up of UPS) page.up.add(new Option(up));
  let viewer: Viewer;
  try {
    viewer = await Viewer.on(page.canvas);
  } catch {
    page.problem.textContent = 'This browser has no WebGL 2, without which nothing can be drawn.';
    return;
  }
  await new Page(viewer).start();
}

void main();
