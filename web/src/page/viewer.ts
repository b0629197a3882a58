/** Renders one model, or two side by side, with PlayCanvas. */
import {
  AppBase, AppOptions, CameraComponentSystem, Color, createGraphicsDevice, Entity, GAMMA_SRGB, GSplatComponentSystem,
  GSplatData, GSplatResource, Layer, RESOLUTION_FIXED, TONEMAP_NONE, Vec3, Vec4,
} from 'playcanvas';
import { type Gaussians, mostVisible } from '../core/gaussians.ts';
import { plyColumns } from '../files/ply.ts';
import { type Pose, verticalFov } from './pose.ts';

const [NEAREST, FURTHEST] = [1e-3, 1e4]; // clip planes relative to the target's distance
const SLOW = 120; // ms per frame above which motion is drawn coarsely,
const COARSE = 0.5; // at this share of the resolution,
const COARSE_COUNT = 15_000; // with at most this many Gaussians, the most visible ones
const LARGE = 100_000; // Gaussians; larger models are coarse at first, as all of them take seconds
const ROWS = 4096; // rows per batch, which fit in the cache
const POLL = 4; // ms
const AT_REST = 250; // ms without a change until the fine picture
type Side = 'left' | 'right';

interface Half {
  readonly layer: Layer;
  readonly camera: Entity;
  model: Gaussians | null;
  pose: Pose | null;
  splats: Entity | null;
  coarse: Entity | null; // its most visible Gaussians
}

export class Viewer {
  private readonly halves: Record<Side, Half>;
  private scale = 1;
  private moving = false;
  private lastChange = 0;
  private inFlight = false; // a frame is being drawn
  private drawing = false; // the engine's current frame draws
  private wanted = false; // another frame should follow
  private started = 0;
  private asleep = false; // until there is something to draw: without a GPU, the engine's empty frames take a whole core
  private slowFrames = 0;
  private slow = false; // the last picture at rest was slow, so motion starts coarse
  private split = 1; // share of the width for the left model
  private whenReady: (() => void)[] = [];
  private ready = false;

  private constructor(private readonly app: AppBase, readonly canvas: HTMLCanvasElement) {
    this.halves = { left: this.half('left', 0), right: this.half('right', 1) };
    app.autoRender = false;
    const system = app.systems.gsplat as GSplatComponentSystem;
    system.on('frame:request', () => this.draw());
    app.scene.on('gsplat:sorted', () => this.draw());
    system.on('frame:ready', (_camera: unknown, _layer: unknown, ready: boolean) => (this.ready = ready));
    app.on('framerender', () => {
      this.drawing = app.renderNextFrame; // other frames draw nothing
      if (!this.drawing) return;
      this.wanted = false; // this frame shows all changes up to now
      this.resize();
    });
    app.on('frameend', () => {
      if (this.drawing) return this.afterFrame();
      this.asleep = true;
      AppBase.cancelTick(app);
    });
    app.graphicsDevice.on('devicerestored', () => this.restore());
    app.start();
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  /** Throws without WebGL 2. */
  static async create(canvas: HTMLCanvasElement): Promise<Viewer> {
    const device = await createGraphicsDevice(canvas, {
      deviceTypes: ['webgl2'], antialias: false, depth: true, alpha: false,
    } as object);
    const options = new AppOptions();
    options.graphicsDevice = device;
    options.componentSystems = [CameraComponentSystem, GSplatComponentSystem];
    const app = new AppBase(canvas);
    app.init(options);
    const splats = app.scene.gsplat;
    splats.dataFormat = 'large';
    splats.minPixelSize = 0;
    splats.minContribution = 0;
    return new Viewer(app, canvas);
  }

  /** Shows a model, or nothing, on one side; an empty right side is hidden. */
  show(model: Gaussians | null, side: Side = 'left'): void {
    const half = this.halves[side];
    for (const entity of [half.splats, half.coarse]) {
      if (!entity) continue;
      const old = (entity.gsplat as unknown as { resource: GSplatResource }).resource;
      entity.destroy();
      old.destroy();
    }
    half.model = model;
    half.splats = half.coarse = null;
    if (model && (this.slow || model.count > LARGE)) this.setScale(COARSE);
    this.place(half);
    this.layOut();
    this.touch();
  }

  /** After a lost context. */
  private restore(): void {
    this.inFlight = false;
    for (const side of ['left', 'right'] as const) this.show(this.halves[side].model, side);
  }

  /** `colour`: #rrggbb. */
  setBackground(colour: string): void {
    for (const { camera } of Object.values(this.halves)) camera.camera!.clearColor = new Color().fromString(colour);
    this.touch();
  }

  private splats(model: Gaussians, layer: Layer): Entity {
    const entity = new Entity();
    entity.addComponent('gsplat', { layers: [layer.id] });
    (entity.gsplat as unknown as { resource: unknown }).resource = new GSplatResource(
      this.app.graphicsDevice, gsplatData(model),
    );
    this.app.root.addChild(entity);
    return entity;
  }

  /** Places the border between the models at a share of the width. */
  setSplit(share: number): void {
    this.split = share;
    this.layOut();
    this.touch();
  }

  setPose(pose: Pose, side: Side = 'left'): void {
    const distance = Math.hypot(...pose.eye.map((each, axis) => each - pose.target[axis]));
    const { camera } = this.halves[side];
    camera.setPosition(...pose.eye);
    camera.lookAt(new Vec3(...pose.target), new Vec3(...pose.up));
    camera.camera!.nearClip = NEAREST * distance;
    camera.camera!.farClip = FURTHEST * distance;
    this.halves[side].pose = pose;
    if (this.slow) this.setScale(COARSE);
    this.touch();
  }

  /** Resolves when a fine picture of the current models and poses is drawn. */
  async settled(): Promise<void> {
    if (!this.inFlight && !this.moving && this.ready) return;
    await new Promise<void>((resolve) => {
      this.whenReady.push(resolve);
      this.draw();
    });
  }

  /** The current picture in full resolution, as PNG. */
  async snapshot(): Promise<Blob> {
    await this.settled();
    return new Promise((resolve, reject) => {
      this.app.once('frameend', () =>
        this.canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error('no picture'))), 'image/png'),
      );
      this.draw(); // the buffer is empty between frames
    });
  }

  private half(name: Side, order: number): Half {
    const layer = new Layer({ name });
    this.app.scene.layers.push(layer);
    const camera = new Entity(`camera ${name}`);
    camera.addComponent('camera', {
      clearColor: new Color(0, 0, 0, 1), layers: [layer.id], priority: order,
      gammaCorrection: GAMMA_SRGB, toneMapping: TONEMAP_NONE,
    });
    // The engine ignores the scissor rectangle unless this internal flag is set.
    (camera.camera as unknown as { camera: { _scissorRectClear: boolean } }).camera._scissorRectClear = true;
    this.app.root.addChild(camera);
    return { layer, camera, model: null, pose: null, splats: null, coarse: null };
  }

  private layOut(): void {
    const { left, right } = this.halves;
    const share = right.model ? this.split : 1;
    left.camera.camera!.scissorRect = new Vec4(0, 0, share, 1);
    right.camera.camera!.scissorRect = new Vec4(share, 0, 1 - share, 1);
    left.camera.enabled = share > 0;
    right.camera.enabled = share < 1;
  }

  private touch(): void {
    this.lastChange = performance.now();
    this.moving = true;
    this.ready = false;
    this.draw();
  }

  private draw(): void {
    this.wanted = this.inFlight;
    if (this.inFlight) return;
    this.inFlight = true;
    this.started = performance.now();
    this.app.renderNextFrame = true;
    if (this.asleep) this.app.requestAnimationFrame();
    this.asleep = false;
  }

  /** Called right before a frame, since resizing clears the canvas. */
  private resize(): void {
    const ratio = Math.min(window.devicePixelRatio || 1, 2) * this.scale;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    if (!width || !height) return;
    for (const { camera, pose } of Object.values(this.halves)) if (pose) camera.camera!.fov = verticalFov(pose, width / height);
    this.app.setCanvasResolution(RESOLUTION_FIXED, Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio)));
  }

  private setScale(scale: number): void {
    if (scale === this.scale) return;
    this.scale = scale;
    for (const half of Object.values(this.halves)) this.place(half);
  }

  /** Enables the Gaussians for the current resolution; creates them on first use. */
  private place(half: Half): void {
    const { model, layer } = half;
    if (model === null) return;
    const coarse = this.scale < 1 && model.count > COARSE_COUNT;
    if (coarse) half.coarse ??= this.splats(mostVisible(model, COARSE_COUNT), layer);
    else half.splats ??= this.splats(model, layer);
    if (half.coarse) half.coarse.enabled = coarse;
    if (half.splats) half.splats.enabled = !coarse;
  }

  /** Waits for the GPU, so that frames do not queue up on slow ones. */
  private afterFrame(): void {
    const gl = (this.app.graphicsDevice as unknown as { gl: WebGL2RenderingContext }).gl;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const poll = (): void => {
      if (fence !== null && !gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) {
        setTimeout(poll, POLL);
        return;
      }
      gl.deleteSync(fence);
      this.finishFrame();
    };
    setTimeout(poll, 0);
  }

  private finishFrame(): void {
    const now = performance.now();
    this.inFlight = false;
    this.canvas.dataset.frames = String(Number(this.canvas.dataset.frames ?? 0) + 1);
    if (!this.moving) this.slow = now - this.started > SLOW;
    if (this.moving) {
      this.slowFrames = now - this.started > SLOW ? this.slowFrames + 1 : 0;
      if (this.slowFrames > 1 && now - this.lastChange < AT_REST) this.setScale(COARSE);
      if (now - this.lastChange > AT_REST) {
        this.moving = false;
        this.slowFrames = 0;
        this.setScale(1);
      }
      this.draw();
    } else if (this.wanted || (this.whenReady.length && !this.ready)) this.draw();
    else for (const resolve of this.whenReady.splice(0)) resolve();
  }
}

/** A model as PlayCanvas's data: columns by .ply property name. */
function gsplatData(model: Gaussians): GSplatData {
  const { count } = model;
  const properties = plyColumns(model.shDegree).map(({ name, to, offset }) => {
    return { name, type: 'float', storage: new Float32Array(count), byteSize: 4, values: model[to], offset };
  });
  for (let first = 0; first < count; first += ROWS) {
    for (const { storage, values, offset } of properties) {
      const width = values.length / count;
      for (let row = first; row < Math.min(first + ROWS, count); row++) storage[row] = values[row * width + offset];
    }
  }
  return new GSplatData([{ name: 'vertex', count, properties }] as never);
}
