/** A pixel of the frame. */
export interface Cursor {
  column: number;
  row: number;
}
