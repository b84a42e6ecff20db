// The hand in 3D: the project's own view of it, fed over a web socket of the console while the page is visible.
const RETRY_MS = 1500;

export default {
  template: `<div class="hand-box" ref="box"></div>`,
  async mounted() {
    const { HandView } = await import("/hand-view/hand.js");
    if (!this.$refs.box) return;
    this.view = new HandView(this.$refs.box, { theme: this.theme(), label: "The hand in 3D" });
    this.themes = new MutationObserver(() => this.view.setTheme(this.theme()));
    this.themes.observe(document.body, { attributeFilter: ["class"] });
    this.onVisible = () => (document.hidden ? this.stop() : this.start());
    document.addEventListener("visibilitychange", this.onVisible);
    this.onVisible();
  },
  unmounted() {
    document.removeEventListener("visibilitychange", this.onVisible);
    this.themes?.disconnect();
    this.stop();
    this.view?.dispose();
  },
  methods: {
    theme() {
      return document.body.classList.contains("body--dark") ? "dark" : "light";
    },
    reset() {
      this.view?.resetCamera();
    },
    start() {
      if (this.socket) return;
      const scheme = location.protocol === "https:" ? "wss://" : "ws://";
      const socket = new WebSocket(`${scheme}${location.host}/console/hands`);
      socket.onmessage = (event) => {
        for (const line of event.data.split("\n")) if (line) this.view.push(line);
        requestAnimationFrame(() => socket.readyState === WebSocket.OPEN && socket.send("next"));
      };
      socket.onclose = () => {
        if (this.socket !== socket) return;
        this.socket = null;
        this.retry = setTimeout(() => this.onVisible(), RETRY_MS);
      };
      this.socket = socket;
    },
    stop() {
      clearTimeout(this.retry);
      const socket = this.socket;
      this.socket = null;
      if (socket) socket.close();
    },
  },
};
