// A camera's picture while somebody looks: JPEGs over a web socket of the console, each asked for when the last is shown.
// The socket is open only while the page is visible; its being open is what keeps the camera showing itself.
const RETRY_MS = 1500;
const STEP = 0.01; // of the picture's width, per arrow key

export default {
  template: `
    <div class="camera-view" :class="{ picks: picks }" ref="box" :tabindex="picks ? 0 : -1"
         :role="picks ? 'application' : 'img'" :aria-label="label" @keydown="key" @focus="focused = true" @blur="focused = false">
      <img ref="img" alt="" draggable="false" @click="click" :style="{ visibility: shown ? 'visible' : 'hidden' }">
      <svg v-if="picks && focused && shown" class="camera-cross" viewBox="-20 -20 40 40" aria-hidden="true"
           :style="{ left: 100 * x + '%', top: 100 * y + '%' }">
        <circle r="9"/><path d="M-18 0H-5M5 0H18M0 -18V-5M0 5V18"/>
      </svg>
      <div v-if="note" class="camera-note" role="status">{{ note }}</div>
    </div>`,
  props: { camera: String, mask: Array, picks: Boolean, label: String, pause: Number }, // [ms] before the next picture
  data() {
    return { x: 0.5, y: 0.5, focused: false, shown: false, note: "waiting for a picture …" };
  },
  watch: {
    mask(names) {
      if (this.socket && this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ mask: names }));
    },
  },
  mounted() {
    this.onVisible = () => (document.hidden ? this.stop() : this.start());
    document.addEventListener("visibilitychange", this.onVisible);
    this.onVisible();
  },
  unmounted() {
    document.removeEventListener("visibilitychange", this.onVisible);
    this.stop();
  },
  methods: {
    start() {
      if (this.socket) return;
      const scheme = location.protocol === "https:" ? "wss://" : "ws://";
      const socket = new WebSocket(`${scheme}${location.host}/console/camera/${encodeURIComponent(this.camera)}`);
      socket.binaryType = "arraybuffer"; // 8 bytes, when it was taken [ns], then a JPEG
      socket.onopen = () => socket.send(JSON.stringify({ mask: this.mask || [] }));
      socket.onmessage = (event) => {
        if (typeof event.data === "string") {
          this.note = event.data;
          if (event.data) this.shown = false;
          return;
        }
        const taken = new DataView(event.data).getBigInt64(0).toString();
        const url = URL.createObjectURL(new Blob([new Uint8Array(event.data, 8)], { type: "image/jpeg" }));
        const img = this.$refs.img;
        const next = () => {
          URL.revokeObjectURL(url);
          setTimeout(() => socket.readyState === WebSocket.OPEN && socket.send("next"), this.pause || 0);
        };
        img.onload = () => { this.shown = true; this.taken = taken; this.note = ""; next(); };
        img.onerror = next;
        img.src = url;
      };
      socket.onclose = () => {
        if (this.socket !== socket) return;
        this.socket = null;
        this.shown = false;
        this.note = "no connection to the console";
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
    click(event) {
      if (!this.picks) return;
      const at = this.$refs.img.getBoundingClientRect();
      this.x = (event.clientX - at.left) / at.width;
      this.y = (event.clientY - at.top) / at.height;
      this.emit();
    },
    key(event) {
      if (!this.picks) return;
      const step = event.shiftKey ? 5 * STEP : STEP;
      const by = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] }[event.key];
      if (by) {
        this.x = Math.min(1, Math.max(0, this.x + by[0]));
        this.y = Math.min(1, Math.max(0, this.y + by[1]));
      } else if (event.key === "Enter" || event.key === " ") {
        this.emit();
      } else return;
      event.preventDefault();
    },
    emit() {
      if (this.shown) this.$emit("pick", { x: this.x, y: this.y, taken: this.taken });
    },
  },
};
