using System;
using System.Diagnostics;
using System.Net.WebSockets;
using System.Threading;
using System.Threading.Tasks;

namespace Ultragray
{
    /// <summary>
    /// Frames of a service, over a WebSocket in mode `latest`. A connection that is lost is opened again until this is disposed; the
    /// newest pose that has no frame yet is then asked for again, so that nothing is lost but the frames of the outage.
    /// All of it runs beside the caller's thread.
    /// </summary>
    public sealed class FrameStream : IFrameSource
    {
        const int Window = 2; // frames that may be under way: one comes while one is looked at
        const int FirstBytes = 1 << 16;
        const int LeastBetweenMs = 4; // poses that wait for their frames: the newest stays here, as more would only keep the service busy
        static readonly TimeSpan FirstDelay = TimeSpan.FromMilliseconds(100), MostDelay = TimeSpan.FromSeconds(3);
        static readonly TimeSpan AgainAfter = TimeSpan.FromSeconds(1);
        // So long without the answer that is due, and the connection is taken for dead. A scene that is loaded, or a busy machine, may
        // take longer: it gets more time after each loss.
        static readonly TimeSpan FirstSilence = TimeSpan.FromSeconds(10), MostSilence = TimeSpan.FromSeconds(160);
        static readonly string[] Passing = { "QUEUE_FULL", "RATE_LIMITED", "DEADLINE_EXCEEDED", "NOT_READY" };

        readonly Service service;
        readonly string scene;
        readonly Uri address;
        readonly Exchange exchange = new Exchange();
        readonly CancellationTokenSource stop = new CancellationTokenSource();
        readonly Stopwatch sinceSent = new Stopwatch();
        readonly JsonWriter message = new JsonWriter();
        readonly JsonReader reader = new JsonReader(new byte[0]);
        readonly Task running;
        Frame arriving = new Frame();
        TimeSpan silence = FirstSilence;

        // Of the connection, all written under the exchange's lock:
        CancellationTokenSource connection;
        long sent, acknowledged, settled, refused;
        double answerSentMs, answerArrivedMs; // of the newest answer, by the service's clock and by this one; 0: none has come

        internal FrameStream(Service service, string scene, RenderSettings settings, string name)
        {
            this.service = service;
            this.scene = scene;
            exchange.Set(settings);
            var http = service.Address(scene, "/stream?name=" + Uri.EscapeDataString(name));
            address = new UriBuilder(http) { Scheme = http.Scheme == "https" ? "wss" : "ws" }.Uri;
            running = Task.Run(Run); // away from a context that would bring it back to the caller's thread
        }

        public string Problem => exchange.Problem;

        public RenderSettings Settings
        {
            set { exchange.Set(value); }
        }

        public void Ask(ProbePose pose) => exchange.Ask(pose);

        public bool Take(ref Frame frame) => exchange.Take(ref frame);

        /// <summary>Ends the stream, without waiting for the connection to close.</summary>
        public void Dispose() => stop.Cancel();

        /// <summary>Ends once the stream was disposed and its connection is closed.</summary>
        public Task Ended => running;

        async Task Run()
        {
            var delay = FirstDelay;
            while (!stop.IsCancellationRequested)
            {
                long before = exchange.Answered;
                string problem;
                using (var socket = new ClientWebSocket())
                using (var open = CancellationTokenSource.CreateLinkedTokenSource(stop.Token))
                    problem = await Connected(socket, open);
                if (stop.IsCancellationRequested) break;
                if (exchange.Answered > before) delay = FirstDelay;
                exchange.Tell(0, problem);
                try
                {
                    await Task.Delay(delay, stop.Token);
                }
                catch (OperationCanceledException)
                {
                }
                delay = delay + delay < MostDelay ? delay + delay : MostDelay;
            }
        }

        /// <summary>Exchanges poses and frames until the connection ends, and says why it did.</summary>
        async Task<string> Connected(ClientWebSocket socket, CancellationTokenSource open)
        {
            bool isOpen = false;
            try
            {
                if (service.Key != null) socket.Options.SetRequestHeader("Authorization", "Bearer " + service.Key);
                open.CancelAfter(silence);
                await socket.ConnectAsync(address, open.Token);
                isOpen = true;
                lock (exchange)
                {
                    exchange.Tell(0, null);
                    connection = open;
                    sent = exchange.Answered;
                    settled = 0;
                    answerArrivedMs = 0;
                    Listen();
                }
                // The thread that sends waits where the caller's need not wake it by a task, which would be garbage.
                Task receiving = Receive(socket, open.Token);
                Task sending = Task.Factory.StartNew(() => Send(socket, open.Token), TaskCreationOptions.LongRunning);
                await Task.WhenAny(sending, receiving);
                lock (exchange) connection = null;
                open.Cancel();
                try
                {
                    await Task.WhenAll(sending, receiving);
                }
                finally
                {
                    if (sending.IsFaulted && receiving.IsFaulted) throw receiving.Exception.GetBaseException();
                }
                return null; // not reached: both go on until they fail
            }
            catch (Exception error)
            {
                bool wasSilent = open.IsCancellationRequested && error is OperationCanceledException;
                if (wasSilent) silence = silence + silence < MostSilence ? silence + silence : MostSilence;
                string why = wasSilent ? "it has not answered in time" : error.GetBaseException().Message;
                if (isOpen) return "the connection to " + service.Name + " is lost, and tried again: " + why;
                return await service.WhyNot(scene) ?? service.Name + " takes no stream: " + why;
            }
        }

        void Send(ClientWebSocket socket, CancellationToken open)
        {
            using (open.Register(exchange.Pulse))
            {
                while (true)
                {
                    lock (exchange)
                    {
                        while (!open.IsCancellationRequested && !WriteMessage())
                            Monitor.Wait(exchange, exchange.Asked > sent ? LeastBetweenMs : Timeout.Infinite);
                    }
                    open.ThrowIfCancellationRequested();
                    socket.SendAsync(message.Written, WebSocketMessageType.Text, true, open).GetAwaiter().GetResult();
                }
            }
        }

        /// <summary>Writes what the service does not know yet: the newest pose, and that its frames were taken. False: nothing.</summary>
        bool WriteMessage()
        {
            bool asks = exchange.Asked > sent && (sent <= exchange.Answered || sinceSent.ElapsedMilliseconds >= LeastBetweenMs);
            long taken = Math.Max(exchange.Taken, refused); // a refusal takes room, too
            if (!asks && taken <= acknowledged) return false;
            message.Clear();
            message.Open('{');
            acknowledged = taken;
            message.Member("acknowledged", acknowledged);
            if (asks)
            {
                sent = exchange.Asked;
                sinceSent.Restart();
                message.Member("sequence", sent);
                message.Member("mode", "latest");
                message.Member("window", Window);
                // Settings that were refused are not those of the stream: they are sent until a frame of them has come.
                if (settled < exchange.SetSince) message.Member("settings", exchange.Settings ?? new RenderSettings());
                message.Member("client_time_ms", NowMs());
                exchange.Pose.Write(message);
            }
            if (answerArrivedMs > 0) // aligns the clocks
            {
                message.Name("clock");
                message.Open('{');
                message.Member("answer_sent_ms", answerSentMs);
                message.Member("answer_arrived_ms", answerArrivedMs);
                message.Member("sent_ms", NowMs());
                message.Close('}');
            }
            message.Close('}');
            Listen();
            return true;
        }

        static double NowMs() => Stopwatch.GetTimestamp() * 1e3 / Stopwatch.Frequency;

        async Task Receive(ClientWebSocket socket, CancellationToken open)
        {
            while (true)
            {
                int count = 0;
                WebSocketReceiveResult part;
                do
                {
                    arriving.Reserve(Math.Max(FirstBytes, 2 * count));
                    var room = new ArraySegment<byte>(arriving.Buffer, count, arriving.Buffer.Length - count);
                    part = await socket.ReceiveAsync(room, open);
                    count += part.Count;
                }
                while (!part.EndOfMessage);
                if (part.MessageType == WebSocketMessageType.Close) throw new Exception(part.CloseStatusDescription ?? "it was closed");
                if (part.MessageType == WebSocketMessageType.Binary) ReadFrame(count, NowMs());
                else ReadRefusal(count);
                lock (exchange) Listen();
            }
        }

        /// <summary>Reads a frame: the length of the header (uint32, little endian), the header, the pixels from a multiple of 8 bytes on.</summary>
        void ReadFrame(int count, double arrivedMs)
        {
            var bytes = arriving.Buffer;
            int end = 4 + (bytes[0] | bytes[1] << 8 | bytes[2] << 16 | bytes[3] << 24);
            if (count < 4 || end < 4 || end > count) throw new FormatException("a frame of " + count + " bytes has a header of " + (end - 4));
            reader.Begin(bytes, 4, end);
            arriving.Header.Read(reader);
            arriving.Begin = (end + 7) / 8 * 8;
            arriving.Count = count - arriving.Begin;
            long sequence = arriving.Header.Sequence;
            silence = FirstSilence;
            lock (exchange)
            {
                answerSentMs = arriving.Header.SentMs;
                answerArrivedMs = arrivedMs;
                settled = Math.Max(settled, sequence);
                exchange.Publish(sequence, ref arriving);
            }
        }

        void ReadRefusal(int count)
        {
            var refusal = new RefusalMessage();
            reader.Begin(arriving.Buffer, 0, count);
            refusal.Read(reader);
            lock (exchange)
            {
                settled = 0;
                refused = Math.Max(refused, refusal.Sequence);
                exchange.Pulse();
            }
            exchange.Tell(refusal.Sequence, refusal.Error.Detail);
            if (Array.IndexOf(Passing, refusal.Error.Reason) >= 0) AskAgain(exchange.Asked);
        }

        async void AskAgain(long asked)
        {
            try
            {
                await Task.Delay(AgainAfter, stop.Token);
            }
            catch (OperationCanceledException)
            {
                return;
            }
            lock (exchange)
                if (exchange.Asked == asked) exchange.Ask(exchange.Pose);
        }

        /// <summary>Waits for an answer no longer than `silence` where one is due: a frame that nobody takes may hold up the next.</summary>
        void Listen()
        {
            if (connection == null) return;
            bool isDue = sent > exchange.Answered && !exchange.IsFresh;
            connection.CancelAfter(isDue ? silence : Timeout.InfiniteTimeSpan);
        }
    }
}
