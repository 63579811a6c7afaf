// Why a source has no answer.

/** What went wrong, as one sentence for a reader; `lost` if nothing answered. */
export class SourceError extends Error {
  constructor(message, lost = false) {
    super(message);
    this.lost = lost;
  }
}
