/** Shows the models of a running training, served by `keyss.viewer.live`. */
import { fetchBytes } from './sources.ts';

const INTERVAL = 2000; // ms between polls
const PATIENCE = 3; // failed polls after which the training has ended

const SIDES = ['published', 'secret'] as const;
export type TrainedSide = (typeof SIDES)[number];

interface State {
  readonly title: string;
  readonly iteration: number;
  readonly iterations: number;
  readonly gaussians: number;
  readonly numbers: Record<string, number>; // decibels
  readonly versions: Record<TrainedSide, number>; // 0: no model yet
}

/** Resolves when the training has ended. `tell` receives its state, `trained` every new model; `anew`: it is the first. */
export async function watch(
  address: string, tell: (text: string) => void, trained: (side: TrainedSide, ply: Uint8Array, anew: boolean) => Promise<void>,
): Promise<void> {
  const shown: Record<TrainedSide, number> = { published: 0, secret: 0 };
  const titles: Partial<Record<TrainedSide, string>> = {};
  let state: State | null = null;
  for (let failures = 0; failures < PATIENCE; ) {
    try {
      state = JSON.parse(new TextDecoder().decode(await fetchBytes(address))) as State;
      failures = 0;
      tell(textOf(state));
      for (const side of SIDES) {
        if (state.versions[side] <= shown[side]) continue;
        const ply = await fetchBytes(`${address}/${side}.ply`);
        await trained(side, ply, titles[side] !== state.title);
        shown[side] = state.versions[side];
        titles[side] = state.title;
      }
    } catch {
      failures++;
    }
    await new Promise((resolve) => setTimeout(resolve, INTERVAL));
  }
  tell(`${state ? `${textOf(state)} ` : ''}The training has ended.`);
}

function textOf({ title, iteration, iterations, gaussians, numbers }: State): string {
  if (!title) return 'The training has not begun yet.';
  const count = (each: number): string => each.toLocaleString('en');
  const told = Object.entries(numbers).map(([name, value]) => `, ${name} ${value.toFixed(2)} dB`);
  return `${title}: step ${count(iteration)} of ${count(iterations)}, ${count(gaussians)} Gaussians${told.join('')}.`;
}
