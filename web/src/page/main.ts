/** The page: a published model, a field for a key, and what the key opens. */
import type { Gaussians } from '../core/gaussians.ts';
import { writePly } from '../files/ply.ts';
import { Controls } from './controls.ts';
import { page } from './elements.ts';
import { type TrainedSide, watch } from './live.ts';
import { COLOURINGS, listenToLooks, looked } from './looking.ts';
import { Opener } from './opener.ts';
import { count, placeBorder, preparePanel, save, showKey } from './panel.ts';
import { alike, firstPose, type Pose, poseOfHash, poseToHash, UPS, upOf } from './pose.ts';
import { givenModel } from './sources.ts';
import { Viewer } from './viewer.ts';

const ADDRESS_AFTER = 400; // milliseconds after the last movement
const MAX_BYTES = 2 ** 31;
const EMBEDDED = location.protocol === 'about:'; // in another page, which has the address to itself

class Page {
  private name = 'model';
  private published: Gaussians | null = null;
  private secret: Gaussians | null = null;
  private readonly opener = new Opener((share) => this.searched(share));
  private readonly controls: Controls;
  private pose: Pose = { eye: [0, 0, -1], target: [0, 0, 0], up: upOf(page.main.dataset.up) };
  private addressTimer = 0;
  private loads = 0;
  private attempts = 0;

  constructor(private readonly viewer: Viewer) {
    this.controls = new Controls(page.picture, this.pose, (pose) => this.moved(pose), () => this.firstPose());
    page.up.value = this.pose.up;
    this.listen();
  }

  private listen(): void {
    preparePanel((file) => void this.openFile(file));
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
    page.snapshot.addEventListener('click', () => void this.snapshot());
    page.download.addEventListener('click', () => {
      if (this.secret) save('secret.ply', new Blob([writePly(this.secret) as BlobPart]));
    });
    page.close.addEventListener('click', () => this.closeSecret());
    page.wipe.addEventListener('input', () => this.split(Number(page.wipe.value) / 100));
    listenToLooks(() => {
      this.showPublished();
      if (this.secret) this.split(1); // it is the published one that is looked at
    });
    window.addEventListener('hashchange', ({ newURL }) => {
      const pose = poseOfHash(new URL(newURL).hash); // that of now may be one that was written meanwhile
      if (pose) this.controls.setPose(pose);
    });
  }

  /** A training that goes on, or a model of the page itself, beside it, or in the address. */
  async start(): Promise<void> {
    const live = document.querySelector<HTMLMetaElement>('meta[name="keyss-live"]')?.content;
    if (live) return this.watch(live);
    const source = givenModel();
    if (source === null) return this.say('Open a file, or drop one here.');
    this.say('Loading …');
    let bytes: Uint8Array;
    try {
      bytes = await source.bytes();
    } catch {
      return this.fail('The file in the address could not be loaded.');
    }
    return this.load(bytes, source.name);
  }

  private async openFile(file: File): Promise<void> {
    if (page.main.dataset.live !== undefined) return;
    if (file.size > MAX_BYTES) return this.fail('This file is larger than 2 GiB.');
    return this.load(new Uint8Array(await file.arrayBuffer()), file.name);
  }

  private async load(bytes: Uint8Array, name: string): Promise<void> {
    const own = ++this.loads;
    this.say('Reading …');
    page.problem.textContent = '';
    const { model, error } = await this.opener.load(bytes, name);
    if (own !== this.loads) return;
    if (model === undefined) return this.fail(error ?? 'This file cannot be read.');
    [this.name, this.published] = [name, model];
    this.hideSecret();
    page.open.disabled = page.key.disabled = false;
    page.facts.textContent = `${this.name}\n${count(model.count)} Gaussians, SH degree ${model.shDegree}`;
    document.title = `${name} · keyss viewer`;
    this.showPublished();
    this.controls.setPose((!EMBEDDED && poseOfHash(location.hash)) || this.firstPose());
    await this.picture();
    this.say('');
  }

  /** The models of a training as they are now, and no field for keys. */
  private async watch(address: string): Promise<void> {
    page.main.dataset.live = '';
    document.title = 'keyss, training';
    page.facts.textContent = 'A training, as it is now';
    await watch(address, {
      tell: (text) => this.say(text),
      trained: async (side, ply, anew) => this.trained(side, ply, anew),
    });
  }

  private async trained(side: TrainedSide, ply: Uint8Array, anew: boolean): Promise<void> {
    const { model } = await this.opener.load(ply, `${side}.ply`, true);
    if (model === undefined) return;
    if (side === 'published') {
      this.published = model;
      this.showPublished();
    } else {
      this.secret = model;
      this.viewer.show(model, 'right');
      if (page.revealed.hidden) this.split(0);
      page.revealed.hidden = this.published === null; // nothing to wipe with
    }
    const looks = side === 'secret' || this.secret === null;
    if (looks && (anew || !this.controls.touched)) this.controls.setPose(this.firstPose());
    else this.moved(this.pose);
    await this.picture();
  }

  /**
   * A key that opens nothing changes nothing, and nothing is said about it. The search makes the same passes for every
   * key, and the form is ready again when it ends: how long decoding and rendering a secret take is not part of it.
   */
  private async unlock(): Promise<void> {
    const [key, own] = [page.key.value, this.loads];
    if (!key || this.published === null || page.open.disabled) return;
    const attempt = ++this.attempts;
    delete page.main.dataset.picture;
    this.say('Trying the key …');
    this.searched(0);
    const { model, file } = await this.opener.unlock(key, page.colours.checked);
    if (attempt === this.attempts) this.searched(1); // else the next attempt has begun
    if (file && own === this.loads) {
      const name = file.name.replace(/[^\p{L}\p{N} ._-]/gu, '_') || 'file';
      page.save.textContent = `Save ${name} (${count(file.data.length)} bytes)`;
      page.save.onclick = () => save(name, new Blob([file.data as BlobPart]));
      page.save.hidden = false;
      this.say('A file is hidden here.');
    }
    if (model && own === this.loads) {
      this.reveal(model);
      this.say(`The secret is shown: ${count(model.count)} Gaussians.`);
    }
    await this.picture();
  }

  /** The share of the channels that an attempt has searched, 0 to 1. */
  private searched(share: number): void {
    const ends = share === 1;
    if (ends && !page.open.disabled) return;
    page.open.disabled = !ends;
    page.main.setAttribute('aria-busy', String(!ends));
    page.progress.value = share;
    page.progress.hidden = ends;
    if (!ends) return;
    page.key.value = '';
    showKey(false);
    this.say('');
  }

  /** Seen as what was there before was. */
  private reveal(model: Gaussians): void {
    const pose = alike(this.pose, this.secret ?? this.published ?? model, model);
    this.secret = model;
    this.viewer.show(model, 'right');
    this.split(0);
    page.revealed.hidden = false;
    this.controls.setPose(pose);
  }

  private closeSecret(): void {
    const pose = this.secret && this.published ? alike(this.pose, this.secret, this.published) : this.pose;
    this.hideSecret();
    this.controls.setPose(pose);
    this.writeAddress();
    this.say('');
    page.key.focus();
  }

  private hideSecret(): void {
    this.secret = null;
    page.revealed.hidden = page.save.hidden = true;
    this.viewer.show(null, 'right');
    placeBorder(null);
  }

  /** How much of the width shows the published model, beside the secret: 0 to 1. */
  private split(share: number): void {
    page.wipe.value = String(100 * share);
    this.viewer.setSplit(share);
    placeBorder(share);
  }

  private async snapshot(): Promise<void> {
    save(`${this.name.replace(/\.\w+$/, '') || 'view'}.png`, await this.viewer.snapshot());
  }

  private firstPose(): Pose {
    const model = this.secret ?? this.published;
    const aspect = page.picture.clientWidth / Math.max(1, page.picture.clientHeight);
    return model ? firstPose(model, this.pose.up, aspect || 1) : this.pose;
  }

  private moved(pose: Pose): void {
    this.pose = pose;
    page.up.value = pose.up;
    if (this.secret) this.viewer.setPose(pose, 'right');
    this.viewer.setPose(this.secret && this.published ? alike(pose, this.secret, this.published) : pose);
    clearTimeout(this.addressTimer);
    this.addressTimer = window.setTimeout(() => this.writeAddress(), ADDRESS_AFTER);
  }

  /** Not while a secret is shown: a pose in its coordinates would tell of it to whoever gets the address. */
  private writeAddress(): void {
    clearTimeout(this.addressTimer);
    const hash = poseToHash(this.pose);
    if (this.published && !this.secret && !EMBEDDED && location.hash !== hash) history.replaceState(null, '', hash);
  }

  private showPublished(): void {
    if (this.published === null) return;
    const model = looked(this.published);
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

async function main(): Promise<void> {
  for (const colouring of COLOURINGS) page.colouring.add(new Option(colouring));
  for (const up of UPS) page.up.add(new Option(up));
  let viewer: Viewer;
  try {
    viewer = await Viewer.on(page.picture);
  } catch {
    page.problem.textContent = 'This browser has no WebGL 2, without which nothing can be drawn.';
    return;
  }
  await new Page(viewer).start();
}

void main();
