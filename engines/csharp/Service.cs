using System;
using System.Collections.Generic;
using System.IO;
using System.Net.Http;
using System.Net.Http.Headers;
using System.Text;
using System.Threading.Tasks;

namespace Ultragray
{
    /// <summary>A refusal of the service. Programs match `Reason`, which never changes.</summary>
    public sealed class ServiceException : Exception
    {
        public ServiceException(string reason, string field, string detail) : base(detail)
        {
            Reason = reason;
            Field = field;
        }

        public string Reason { get; }

        /// <summary>Path of the value to blame; null if none is.</summary>
        public string Field { get; }
    }

    /// <summary>
    /// A service over HTTP. Calls end with ServiceException where it refuses, and with HttpRequestException where nobody answers.
    /// </summary>
    public sealed class Service : IDisposable
    {
        readonly HttpClient http = new HttpClient();

        /// <summary>`origin` such as http://localhost:8000; `key` where the service asks for one.</summary>
        public Service(string origin, string key = null)
        {
            Uri parsed;
            bool isOrigin = Uri.TryCreate(origin, UriKind.Absolute, out parsed) && (parsed.Scheme == "http" || parsed.Scheme == "https");
            if (!isOrigin) throw new ArgumentException("the address of a service must be like http://localhost:8000, got " + origin);
            Origin = parsed;
            Key = string.IsNullOrEmpty(key) ? null : key;
            if (Key != null) http.DefaultRequestHeaders.Authorization = new AuthenticationHeaderValue("Bearer", Key);
        }

        public Uri Origin { get; }

        internal string Key { get; }

        internal string Name => Origin.GetLeftPart(UriPartial.Authority);

        /// <summary>The names of the scenes that can be rendered.</summary>
        public async Task<string[]> SceneNames()
        {
            var names = new List<string>();
            string token = "";
            do
            {
                var page = await Answer<ScenePage>(new Uri(Origin, "/v1/scenes?page_token=" + Uri.EscapeDataString(token)));
                foreach (var scene in page.Scenes)
                    if (scene.Error == null) names.Add(scene.Name);
                token = page.NextPageToken;
            }
            while (!string.IsNullOrEmpty(token));
            return names.ToArray();
        }

        /// <summary>All that a scene says of itself: probe, bounds, where the training sweep ran, labels.</summary>
        public Task<SceneDetails> Scene(string name)
        {
            return Answer<SceneDetails>(Address(name, ""));
        }

        /// <summary>The scene file, compressed, while it arrives: for LocalFrames.</summary>
        public async Task<Stream> Download(string name)
        {
            var answer = await Send(new HttpRequestMessage(HttpMethod.Get, Address(name, "/file.ugz")), HttpCompletionOption.ResponseHeadersRead);
            return await answer.Content.ReadAsStreamAsync();
        }

        /// <summary>One frame.</summary>
        public async Task<Frame> Render(string name, ProbePose pose, RenderSettings settings = null)
        {
            settings = settings ?? new RenderSettings();
            var json = new JsonWriter();
            json.Open('{');
            pose.Write(json);
            settings.WriteFrameSettings(json);
            json.Member("registration", settings.Registration);
            json.Close('}');
            string word = Words.PixelEncoding[(int)settings.Encoding];
            bool isImage = settings.Encoding == PixelEncoding.Png || settings.Encoding == PixelEncoding.Jpeg;
            var request = new HttpRequestMessage(HttpMethod.Post, Address(name, "/render"));
            request.Headers.Accept.ParseAdd(isImage ? "image/" + word : "application/octet-stream;dtype=" + word);
            request.Content = new ByteArrayContent(json.Written.ToArray());
            request.Content.Headers.ContentType = new MediaTypeHeaderValue("application/json");
            using (var answer = await Send(request))
            {
                var bytes = await answer.Content.ReadAsByteArrayAsync();
                var frame = new Frame { Buffer = bytes, Count = bytes.Length };
                frame.Header.Read(new JsonReader(Encoding.UTF8.GetBytes(HeaderOf(answer))));
                return frame;
            }
        }

        /// <summary>Frames of one scene as poses are asked for. `name`: of the stream, for those who watch it.</summary>
        public FrameStream Stream(string scene, RenderSettings settings = null, string name = "C#")
        {
            return new FrameStream(this, scene, settings, name);
        }

        public void Dispose()
        {
            http.Dispose();
        }

        internal Uri Address(string scene, string rest)
        {
            return new Uri(Origin, "/v1/scenes/" + Uri.EscapeDataString(scene) + rest);
        }

        /// <summary>Why a scene cannot be streamed, which the refusal of a WebSocket does not tell; null: HTTP knows no reason.</summary>
        internal async Task<string> WhyNot(string scene)
        {
            try
            {
                await Scene(scene);
                using (await Send(new HttpRequestMessage(HttpMethod.Get, new Uri(Origin, "/v1/health/ready")))) return null;
            }
            catch (ServiceException error)
            {
                return Name + " refuses: " + error.Message;
            }
            catch (Exception error)
            {
                return "no service answers at " + Name + ": " + error.GetBaseException().Message;
            }
        }

        async Task<T> Answer<T>(Uri address) where T : IReadable, new()
        {
            using (var answer = await Send(new HttpRequestMessage(HttpMethod.Get, address)))
            {
                var read = new T();
                read.Read(new JsonReader(await answer.Content.ReadAsByteArrayAsync()));
                return read;
            }
        }

        async Task<HttpResponseMessage> Send(HttpRequestMessage request, HttpCompletionOption until = HttpCompletionOption.ResponseContentRead)
        {
            var answer = await http.SendAsync(request, until);
            if (answer.IsSuccessStatusCode) return answer;
            using (answer)
            {
                var refusal = new Refusal();
                bool isProblem = answer.Content.Headers.ContentType?.MediaType == "application/problem+json";
                if (isProblem) refusal.Read(new JsonReader(await answer.Content.ReadAsByteArrayAsync()));
                throw new ServiceException(refusal.Reason, refusal.Field, refusal.Detail ?? request.RequestUri + " answers " + (int)answer.StatusCode);
            }
        }

        /// <summary>The facts of a frame as JSON, of the headers X-Ultragray-…: texts as they are, lists with commas, else JSON.</summary>
        static string HeaderOf(HttpResponseMessage answer)
        {
            var json = new StringBuilder("{");
            foreach (string name in FrameHeader.Texts) Add(json, answer, name, text => "\"" + text + "\"");
            foreach (string name in FrameHeader.TextLists) Add(json, answer, name, text => "[\"" + text.Replace(",", "\",\"") + "\"]");
            foreach (string name in FrameHeader.Others) Add(json, answer, name, text => text);
            return json.Append('}').ToString();
        }

        static void Add(StringBuilder json, HttpResponseMessage answer, string name, Func<string, string> quoted)
        {
            IEnumerable<string> values;
            if (!answer.Headers.TryGetValues("X-Ultragray-" + name.Replace('_', '-'), out values)) return;
            json.Append(json.Length > 1 ? "," : "").Append('"').Append(name).Append("\":").Append(quoted(string.Join(",", values)));
        }
    }
}
