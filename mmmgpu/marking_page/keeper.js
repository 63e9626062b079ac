// The server's side of the page: it keeps the points, says what is wrong with them and saves them.

export class Keeper {
  // pointsOf(kind): what to keep. kept(kind, problems): the server has them. changed(): show it.
  constructor({ pointsOf, kept, changed }) {
    Object.assign(this, { pointsOf, kept, changed });
    this.revision = 0;
    this.saved = true;
    this.failure = ""; // why the last request came to nothing
    this.unsent = new Set(); // kinds whose points the server does not have yet
    this.sending = null;
  }

  async ask(path, method = "GET", body = undefined) {
    let answer;
    try {
      answer = await fetch(path, { method, body: body && JSON.stringify(body) });
    } catch {
      throw new Error("mmmgpu mark is no longer running; call it again to go on");
    }
    if (answer.ok) return answer;
    throw new Error((await answer.json()).error);
  }

  async begin() {
    const state = await (await this.ask("state")).json();
    this.#take(state);
    return state;
  }

  // Send the points of `kind`, changed just now; one request at a time, and of several changes
  // during one request only the last.
  send(kind) {
    this.saved = false;
    this.unsent.add(kind);
    return this.#flush();
  }

  async save(path) {
    await this.sending;
    if (this.unsent.size) await this.#flush();
    if (this.unsent.size) return false; // the failure is known
    try {
      this.#take(await (await this.ask(path, "POST", {})).json());
      return true;
    } catch (error) {
      this.failure = `not saved: ${error.message}`;
      return false;
    }
  }

  // The names of folding points, and the address of the warped picture; null if there is none.
  async warped(kind) {
    try {
      const folded = (await (await this.ask(`folded/${kind}`)).json()).points;
      const picture = await (await this.ask(`warped/${kind}`)).blob();
      return { folded, address: URL.createObjectURL(picture) };
    } catch (error) {
      this.failure = error.message;
      return null;
    }
  }

  #flush() {
    this.sending ??= this.#sendAll().finally(() => {
      this.sending = null;
      this.changed();
    });
    return this.sending;
  }

  async #sendAll() {
    while (this.unsent.size) {
      const [kind] = this.unsent;
      this.unsent.delete(kind);
      try {
        const body = { revision: this.revision, points: this.pointsOf(kind) };
        const state = await (await this.ask(`points/${kind}`, "PUT", body)).json();
        this.#take(state);
        await this.kept(kind, state.problems);
      } catch (error) {
        this.unsent.add(kind); // goes with the next change, or before saving
        this.failure = error.message;
        return;
      }
    }
  }

  #take({ revision, saved }) {
    this.revision = revision;
    this.saved = saved && !this.unsent.size;
    this.failure = "";
  }
}
