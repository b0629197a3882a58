/** Camera controls by mouse, touch and keyboard. */
import { add, combined, difference, distance, length } from '../core/vectors.ts';
import { axes, type Pose, orbit } from './pose.ts';

const TURN = 0.005; // radians per pixel
const KEY_TURN = 0.08; // radians per press of an arrow key
const KEY_STEP = 0.06; // of the distance per press
const KEY_ZOOM = 1.1;
const ROTATION = 0.0003; // radians per ms
const [NEAREST, FURTHEST] = [1e-4, 1e5];

export class Controls {
  onRotate = (_: boolean): void => undefined; // receives whether auto-rotation is on
  isRotating = false;
  private frame = 0; // the next animation frame
  private readonly pointers = new Map<number, { x: number; y: number }>();

  /** `onPose` receives every new pose; `home` returns the first one. */
  constructor(
    canvas: HTMLCanvasElement, private pose: Pose, private readonly onPose: (pose: Pose) => void,
    private readonly home: () => Pose,
  ) {
    canvas.style.touchAction = 'none';
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.touch();
      this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    canvas.addEventListener('pointermove', (event) => this.drag(event, canvas.clientHeight));
    for (const name of ['pointerup', 'pointercancel'] as const) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    canvas.addEventListener('wheel', (event) => {
      event.preventDefault();
      this.touch();
      // Browsers report a trackpad pinch as a wheel with Ctrl, and some report lines instead of pixels.
      this.zoom(Math.exp(event.deltaY * (event.ctrlKey ? 0.01 : 0.001) * (event.deltaMode ? 16 : 1)));
    }, { passive: false });
    canvas.addEventListener('keydown', (event) => this.press(event));
  }

  setPose(pose: Pose): void {
    this.pose = pose;
    this.onPose(pose);
  }

  /** Auto-rotates until the user moves the camera. */
  rotate(on: boolean): void {
    cancelAnimationFrame(this.frame);
    let before = performance.now();
    const next = (now: number): void => {
      this.turn(Math.max(0, now - before) * ROTATION, 0);
      before = now;
      this.frame = requestAnimationFrame(next);
    };
    if (on) this.frame = requestAnimationFrame(next);
    this.isRotating = on;
    this.onRotate(on);
  }

  private touch(): void {
    if (this.isRotating) this.rotate(false);
  }

  private drag(event: PointerEvent, height: number): void {
    const before = this.pointers.get(event.pointerId);
    if (before === undefined) return;
    const [dx, dy] = [event.clientX - before.x, event.clientY - before.y];
    if (this.pointers.size === 2) this.pinch(event, dx, dy, height);
    else if (event.shiftKey || event.buttons & 6) this.move(-dx / height, -dy / height, 0);
    else this.turn(dx * TURN, dy * TURN);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  private pinch(event: PointerEvent, dx: number, dy: number, height: number): void {
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)![1];
    const own = this.pointers.get(event.pointerId)!;
    const span = (x: number, y: number): number => Math.max(1, Math.hypot(x - other.x, y - other.y));
    this.zoom(span(own.x, own.y) / span(event.clientX, event.clientY));
    this.move(-dx / (2 * height), -dy / (2 * height), 0);
  }

  private press(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const actions: Record<string, () => void> = {
      ArrowLeft: () => this.turn(KEY_TURN, 0),
      ArrowRight: () => this.turn(-KEY_TURN, 0),
      ArrowUp: () => this.turn(0, KEY_TURN),
      ArrowDown: () => this.turn(0, -KEY_TURN),
      w: () => this.move(0, 0, KEY_STEP),
      s: () => this.move(0, 0, -KEY_STEP),
      a: () => this.move(-KEY_STEP, 0, 0),
      d: () => this.move(KEY_STEP, 0, 0),
      q: () => this.move(0, KEY_STEP, 0),
      e: () => this.move(0, -KEY_STEP, 0),
      '+': () => this.zoom(1 / KEY_ZOOM),
      '=': () => this.zoom(1 / KEY_ZOOM),
      '-': () => this.zoom(KEY_ZOOM),
      Home: () => this.setPose(this.home()),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (action === undefined) return;
    event.preventDefault();
    this.touch();
    action();
  }

  /** Orbits the target. */
  private turn(azimuth: number, elevation: number): void {
    const { eye, target, up } = this.pose;
    this.setPose({ ...this.pose, eye: add(target, orbit(difference(eye, target), up, azimuth, elevation)) });
  }

  private zoom(factor: number): void {
    const { eye, target } = this.pose;
    const offset = difference(eye, target);
    const bounded = Math.min(Math.max(length(offset) * factor, NEAREST), FURTHEST);
    this.setPose({ ...this.pose, eye: add(target, offset, bounded / length(offset)) });
  }

  /** Moves by shares of the distance to the target. */
  private move(right: number, down: number, forward: number): void {
    const { eye, target } = this.pose;
    const directions = axes(this.pose);
    const step = combined([right, down, forward], [directions.right, directions.down, directions.forward]);
    const far = distance(eye, target);
    this.setPose({ ...this.pose, eye: add(eye, step, far), target: add(target, step, far) });
  }
}
