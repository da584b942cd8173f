/** How poses are told in a session: against what, in which form. */

import {
  flangePose, fromPositionQuaternion, type Place, placeIn, type Pose, position, probePose, quaternion,
  type Reference, type Registered, withPlaceIn, withPosition,
} from "../geometry/pose";
import type { PoseForm } from "../geometry/pose_files";
import { besideSession, type Session } from "../session/session.svelte";

export const MOST_MM = 10_000; // beyond, a typed position is a slip

export class PoseTelling {
  reference = $state<Reference>("absolute");
  form = $state<PoseForm>("json");
  /** Tells poses as a robot or a tracker does; null: of the probe, in the scene. */
  registered = $state.raw<Registered | null>(null);
  /** Whether relative poses are told against the mark; else against Home. */
  fromMark = $state(false);
  mark = $state.raw<Pose | null>(null);
  readonly other = $derived.by(() => (this.fromMark && this.mark ? this.mark : this.session.held(this.session.scene.home)));

  constructor(private readonly session: Session) {}

  setMark(pose: Pose): void {
    this.mark = pose;
    this.fromMark = true;
    if (this.reference === "absolute") this.reference = "relativeProbe";
  }

  /** A pose of the probe as it is shown: in the scene, or by the registration. */
  told(pose: Pose): Pose {
    return this.registered === null ? pose : flangePose(this.registered, pose);
  }

  /** Its inverse. */
  meant(told: Pose): Pose {
    return this.registered === null ? told : probePose(this.registered, told);
  }

  place(pose: Pose): Place {
    return placeIn(this.told(pose), this.reference, this.told(this.other));
  }

  /** Moves the probe along one axis of what is told. */
  setPosition(index: number, value_mm: number): void {
    const place = this.place(this.session.pose);
    const moved = this.#meantBy({ ...place, position_mm: replaced(place.position_mm, index, value_mm) });
    const turn = fromPositionQuaternion([0, 0, 0], quaternion(this.session.pose)); // its digits stay as they are
    this.session.pose = withPosition(turn, position(moved));
  }

  /** Turns the probe about its face. */
  setAngle(index: number, value_deg: number): void {
    const place = this.place(this.session.pose);
    const turned = this.#meantBy({ ...place, angles_deg: replaced(place.angles_deg, index, value_deg) });
    this.session.turnTo(quaternion(turned));
  }

  #meantBy(place: Place): Pose {
    return this.meant(withPlaceIn(place, this.reference, this.told(this.other)));
  }
}

function replaced(vector: Place["position_mm"], index: number, value: number): Place["position_mm"] {
  return vector.map((before, i) => (i === index ? value : before)) as unknown as Place["position_mm"];
}

/** That of a session; the same for every view. */
export const tellingOf = besideSession((session) => new PoseTelling(session));
